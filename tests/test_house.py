"""The house rules, checked from the source text: floors, bans, names, sizes, and what an import costs.

Every rule is also shown a text that breaks it, so that no rule can fall asleep.
"""

from __future__ import annotations

import ast
import importlib.resources
import os
import re
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SOURCE = ROOT / "src" / "toonifygb"
MODULES = sorted(SOURCE.rglob("*.py"))

FLOORS = {
    0: ("structures", "errors", "progress", "threads", "atomic"),
    1: ("geometry", "metrics", "assets", "config"),
    2: ("video", "face", "head", "stylize", "render"),
    3: ("avatar", "track", "synthetic", "datasets"),
    4: ("train", "drive", "styletrain"),
    5: ("evaluate", "viewer"),
    6: ("pipeline",),
    7: ("batch",),
    8: ("cli",),
    9: ("__main__",),
}
"""A room imports floors below its own only; rooms of one floor meet through structures."""
FLOOR_OF = {room: floor for floor, rooms in FLOORS.items() for room in rooms}

ALLOWED_IN = {
    "torch": ("",),
    "numpy": ("",),
    "safetensors": ("",),
    "jaxtyping": ("",),
    "av": ("video/",),
    # Image maths only; files and cameras are opened in video/ alone, see BANNED_ATTRIBUTES.
    "cv2": ("video/", "face/", "stylize/", "track/overlay.py", "synthetic/", "pipeline/", "train/data.py"),
    "tyro": ("cli/",),
    "onnxruntime": ("stylize/plugin.py",),
    "gsplat": ("render/cuda.py",),
    "triton": ("render/cuda_kernels.py",),
    "ray": ("batch/",),
}
"""Where each third-party module may be imported; no other one may be at all."""
MAY_UNPICKLE = ("assets/convert.py",)
"""The restricted reader of other people's checkpoints; everything it lets through is on a list of its own."""
CV2_FILES = ("imread", "imwrite", "VideoCapture", "VideoWriter", "imreadmulti")
RAISABLE = re.compile(r"(Error|Exception|Stopped|KeyboardInterrupt)$")

MAX_FILE, MAX_FUNCTION, MAX_ARGUMENTS = 400, 80, 8
"""Code lines and arguments at which a look is due; at twice as much the test fails."""
MACHINE_PATH = re.compile(r"(?<![\w./~}])/(?:work|tmp|root|home/\w+|Users/\w+)(?:/|\b)")


def _place(path: Path) -> str:
    return path.relative_to(SOURCE).as_posix()


def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


def _imports(tree: ast.AST, package: tuple[str, ...]) -> list[tuple[str, int]]:
    """Every imported module by full name, with its line; inside functions and for types, too."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [(alias.name, node.lineno) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join((*base, *([node.module] if node.module else [])))
            # "from toonifygb import video" imports a room, not the package.
            names = [f"toonifygb.{alias.name}" for alias in node.names] if module == "toonifygb" else [module]
            found += [(name, node.lineno) for name in names]
    return found


def _floor_breaches(place: str, tree: ast.AST) -> list[str]:
    """Imports of the package's own rooms that do not go down."""
    parts = ("toonifygb", *Path(place).with_suffix("").parts)
    room = parts[1]
    breaches = []
    for name, line in _imports(tree, parts[:-1]):
        pieces = name.split(".")
        if pieces[0] != "toonifygb" or len(pieces) == 1 or pieces[1] in (room, "__version__") or room == "__init__":
            continue
        if pieces[1] not in FLOOR_OF:
            breaches.append(f"{place}:{line}: {pieces[1]} stands on no floor; name it in FLOORS")
        elif FLOOR_OF[pieces[1]] >= FLOOR_OF[room]:
            breaches.append(
                f"{place}:{line}: {room} (floor {FLOOR_OF[room]}) imports {pieces[1]} (floor {FLOOR_OF[pieces[1]]})"
            )
    return breaches


def _foreign_breaches(place: str, tree: ast.AST) -> list[str]:
    """Third-party imports where they do not belong."""
    breaches = []
    for name, line in _imports(tree, ("toonifygb", *Path(place).parent.parts)):
        top = name.split(".")[0]
        if top in sys.stdlib_module_names or top == "toonifygb":
            continue
        if not any(place.startswith(prefix) for prefix in ALLOWED_IN.get(top, ())):
            breaches.append(f"{place}:{line}: imports {top}, allowed in {ALLOWED_IN.get(top, 'no room')}")
    return breaches


def _call_breaches(place: str, call: ast.Call) -> str | None:
    """What is wrong with one call, if anything."""
    called = ast.unparse(call.func)
    leaf = called.rsplit(".", 1)[-1]
    if called == "print" and not place.startswith("cli/"):
        return "prints outside cli"
    if leaf == "cuda" and "." in called and not called.startswith("torch."):
        return "moves to .cuda() instead of a given device"
    if called in ("torch.load", "torch.save", "eval", "exec"):
        return f"calls {called}"
    if called.startswith("cv2.") and leaf in CV2_FILES and not place.startswith("video/"):
        return f"opens files with {called} outside video"
    lax = any(
        k.arg == "strict" and isinstance(k.value, ast.Constant) and k.value.value is False for k in call.keywords
    )
    if lax and called != "zip":
        return f"{called}(strict=False) hides what does not match"
    return None


def _pattern_breaches(place: str, tree: ast.AST) -> list[str]:
    """Banned constructions."""
    breaches = []
    for node in ast.walk(tree):
        finding = None
        if isinstance(node, ast.Call):
            finding = _call_breaches(place, node)
        elif isinstance(node, ast.ExceptHandler) and node.type is None:
            finding = "bare except"
        elif isinstance(node, ast.ImportFrom) and any(alias.name == "*" for alias in node.names):
            finding = "import *"
        elif isinstance(node, ast.Import | ast.ImportFrom):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else [node.module or ""]
            banned = {"pickle", "dill", "shelve", "marshal"} & {name.split(".")[0] for name in names}
            finding = f"imports {', '.join(banned)}" if banned and place not in MAY_UNPICKLE else None
        elif (
            isinstance(node, ast.Expr)
            and isinstance(node.value, ast.Call)
            and RAISABLE.search(ast.unparse(node.value.func).rsplit(".", 1)[-1])
        ):
            finding = f"builds {ast.unparse(node.value.func)} without raising it"
        if finding:
            breaches.append(f"{place}:{node.lineno}: {finding}")  # type: ignore[attr-defined]
    return breaches


def _over_all(rule) -> list[str]:
    return [breach for path in MODULES for breach in rule(_place(path), _tree(path))]


def test_imports_go_down_only():
    assert MODULES
    breaches = _over_all(_floor_breaches)
    assert not breaches, "\n".join(breaches)


def test_every_room_has_a_floor():
    rooms = {
        path.stem if path.suffix == ".py" else path.name for path in SOURCE.iterdir() if path.name[0] not in "_."
    }
    assert rooms <= set(FLOOR_OF), f"name {sorted(rooms - set(FLOOR_OF))} in FLOORS"


def test_third_party_modules_stay_in_their_rooms():
    breaches = _over_all(_foreign_breaches)
    assert not breaches, "\n".join(breaches)


def test_no_banned_constructions():
    breaches = _over_all(_pattern_breaches)
    assert not breaches, "\n".join(breaches)


@pytest.mark.parametrize(
    ("rule", "place", "text"),
    [
        (_floor_breaches, "geometry/x.py", "from toonifygb.video import read"),
        (_floor_breaches, "video/x.py", "def f():\n    import toonifygb.face.detect"),
        (_floor_breaches, "video/x.py", "from toonifygb import render"),
        (_floor_breaches, "video/x.py", "from ..head import base"),
        (_floor_breaches, "structures.py", "from toonifygb.errors import InputError"),
        (_floor_breaches, "cli/x.py", "from toonifygb.attic import old"),
        (_foreign_breaches, "train/x.py", "import av"),
        (_foreign_breaches, "train/x.py", "def f():\n    from cv2 import resize"),
        (_foreign_breaches, "track/fit.py", "import cv2"),
        (_foreign_breaches, "render/native.py", "import gsplat"),
        (_foreign_breaches, "cli/x.py", "import scipy.optimize"),
        (_pattern_breaches, "train/x.py", "print('loss')"),
        (_pattern_breaches, "train/x.py", "model.cuda()"),
        (_pattern_breaches, "train/x.py", "torch.load(path)"),
        (_pattern_breaches, "face/x.py", "cv2.imread(path)"),
        (_pattern_breaches, "face/x.py", "net.load_state_dict(weights, strict=False)"),
        (_pattern_breaches, "face/x.py", "try:\n    pass\nexcept:\n    pass"),
        (_pattern_breaches, "face/x.py", "from math import *"),
        (_pattern_breaches, "face/x.py", "import pickle"),
        (_pattern_breaches, "face/x.py", "from pickle import loads"),
        (_pattern_breaches, "assets/store.py", "import pickle"),
        (_pattern_breaches, "face/x.py", "if bad:\n    errors.InputError('no face')"),
    ],
)
def test_rules_notice(rule, place: str, text: str):
    assert len(rule(place, ast.parse(text))) == 1


@pytest.mark.parametrize(
    ("place", "text"),
    [
        ("video/x.py", "from toonifygb.structures import VideoInfo\nimport av\nimport cv2\ncv2.imread(path)"),
        ("video/x.py", "from .still import load_image\nfrom toonifygb.video import write"),
        ("assets/convert.py", "import pickle"),
        ("cli/x.py", "from toonifygb import __version__\nprint(__version__)"),
        (
            "train/x.py",
            "raise InputError('no frames')\nlate = Stopped()\nzip(a, b, strict=False)\ntorch.cuda.is_available()",
        ),
    ],
)
def test_rules_let_good_code_pass(place: str, text: str):
    tree = ast.parse(text)
    assert not [*_floor_breaches(place, tree), *_foreign_breaches(place, tree), *_pattern_breaches(place, tree)]


def test_file_names_shadow_no_module():
    taken = set(sys.stdlib_module_names) | {*ALLOWED_IN, "scipy", "pytest", "hypothesis"}
    files = [*MODULES, *(ROOT / "tests").rglob("*.py"), *(ROOT / "tools").rglob("*.py")]
    clashes = [
        str(path.relative_to(ROOT)) for path in files if path.stem in taken and not path.stem.startswith("__")
    ]
    assert not clashes


def test_test_files_have_names_of_their_own():
    """Without packages in tests/ two files of one name would be the same module."""
    stems = [path.stem for path in (ROOT / "tests").rglob("*.py") if path.stem != "conftest"]
    assert len(stems) == len(set(stems)), sorted(stem for stem in stems if stems.count(stem) > 1)


def _tracked() -> list[Path]:
    listing = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listing.returncode:
        pytest.skip("not a git checkout")
    paths = [ROOT / name for name in listing.stdout.split("\0") if name]
    return [path for path in paths if path.is_file()]


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        return ""


def test_no_path_of_one_machine():
    found = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for path in _tracked()
        for number, line in enumerate(_text(path).splitlines(), 1)
        if MACHINE_PATH.search(line) and path != Path(__file__).resolve()
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize("text", ["open('/tmp/x')", "cd /tmp", "PATH=/root/bin", "in /home/ann/clips"])
def test_machine_paths_are_noticed(text: str):
    assert MACHINE_PATH.search(text)


@pytest.mark.parametrize(
    "text", ["face/work/x", "../tmp/x", "${out}/tmp", "n/root mean", "/workshop", "https://a.b/work"]
)
def test_other_slashes_are_not(text: str):
    assert not MACHINE_PATH.search(text)


def test_package_data_are_installed():
    """Networks, the open head and style sheets must travel with the package, not only with the checkout."""
    installed = importlib.resources.files("toonifygb")
    names = [_place(path) for path in _tracked() if SOURCE in path.parents and path.suffix != ".py"]
    assert any(name.endswith(".safetensors") for name in names)
    missing = [name for name in names if not installed.joinpath(name).is_file()]
    assert not missing


def test_sizes():
    """Files, functions and argument lists over the house's measure are reported; twice the measure fails."""
    sizes: list[tuple[str, int, int]] = []
    for path in MODULES:
        text, place = path.read_text(encoding="utf-8"), _place(path)
        code = [line for line in text.splitlines() if line.strip() and not line.strip().startswith("#")]
        sizes.append((place, len(code), MAX_FILE))
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                name = f"{place}: {node.name}"
                sizes.append((name, (node.end_lineno or node.lineno) - node.lineno + 1, MAX_FUNCTION))
                if "triton.jit" in map(ast.unparse, node.decorator_list):
                    continue  # a kernel takes pointers and numbers one by one; no record can carry them
                arguments = len(node.args.posonlyargs + node.args.args + node.args.kwonlyargs)
                sizes.append((f"{name} arguments", arguments, MAX_ARGUMENTS))
    for name, size, measure in sizes:
        if size > measure:
            warnings.warn(f"{name}: {size}, the measure is {measure}", stacklevel=1)
    assert not [name for name, size, measure in sizes if size > 2 * measure]


def _modules_after(code: str) -> set[str]:
    """Names of all modules a fresh interpreter holds after running ``code``."""
    report = f"{code}\nimport sys\nsys.stderr.write('\\nMODULES ' + ' '.join(sys.modules))"
    path = os.pathsep.join(filter(None, (str(SOURCE.parent), os.environ.get("PYTHONPATH"))))
    result = subprocess.run(
        [sys.executable, "-c", report],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": path},
    )
    assert result.returncode == 0, result.stderr
    return set(result.stderr.rpartition("MODULES ")[2].split())


@pytest.mark.parametrize(
    "code",
    [
        "import toonifygb, toonifygb.config, toonifygb.errors, toonifygb.progress",
        "import runpy, sys\n"
        "sys.argv = ['toonifygb', '--help']\n"
        "try:\n"
        "    runpy.run_module('toonifygb.cli.main', run_name='__main__')\n"
        "except SystemExit as end:\n"
        "    assert not end.code, end.code",
    ],
    ids=["import", "help"],
)
def test_torch_is_not_imported_before_it_is_needed(code: str):
    assert _modules_after(code) & {"torch", "numpy", "av", "cv2"} == set()


def test_help_needs_no_tty_and_exits_with_zero():
    env = {**os.environ, "PYTHONPATH": str(SOURCE.parent)}
    result = subprocess.run(
        [sys.executable, "-m", "toonifygb.cli.main", "--help"], capture_output=True, text=True, check=False, env=env
    )
    assert result.returncode == 0 and "toonifygb" in result.stdout and result.stderr == ""


def test_code_compiled_per_instruction_set_names_nothing_of_the_standard_library() -> None:
    """The linker would merge its templates across instruction sets, and might keep one the machine lacks."""
    sources = sorted((ROOT / "native" / "src" / "isa").iterdir())
    assert len(sources) > 10
    assert [path.name for path in sources if "std::" in path.read_text()] == []
