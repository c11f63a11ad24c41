"""The fused training kernels of the native engine: float32, on the CPU, in place where the definition is."""

from __future__ import annotations

from ctypes import addressof, c_int32
from typing import TYPE_CHECKING

import torch

from toonifygb.render import library
from toonifygb.render.fused import BETA1, BETA2, EPS, check_blend_step
from toonifygb.render.native import available_threads
from toonifygb.structures import GaussianParams, Splats

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jaxtyping import Float, UInt8
    from torch import Tensor


def _address(tensor: Tensor, name: str, shape: tuple[int, ...], dtype: torch.dtype = torch.float32) -> int:
    """Address of a tensor that the engine can use as it is.

    Raises:
        ValueError: it has another shape, dtype, device or memory layout.
    """
    usable = tensor.dtype == dtype and tensor.device.type == "cpu" and tensor.is_contiguous()
    if not usable or tuple(tensor.shape) != shape:
        found = f"{tensor.dtype} {tuple(tensor.shape)} on {tensor.device}"
        raise ValueError(f"{name} is {found}, expected contiguous {dtype} {shape} on cpu")
    return tensor.data_ptr()


def _rates(step: int, factor: float, eps: float) -> library.AdamRates:
    return library.AdamRates(beta1=BETA1, beta2=BETA2, eps=eps, factor=factor, step=step)


def _skin(raw: GaussianParams, weights: Tensor, transforms: Tensor) -> library.Skin:
    n = raw.n
    return library.Skin(
        means=_address(raw.means, "raw.means", (n, 3)),
        quats=_address(raw.quats, "raw.quats", (n, 4)),
        log_scales=_address(raw.log_scales, "raw.log_scales", (n, 3)),
        opacity_logits=_address(raw.opacity_logits, "raw.opacity_logits", (n,)),
        weights=_address(weights, "weights", (n, 5)),
        transforms=_address(transforms, "transforms", (5, 4, 4)),
        n=n,
    )


def _skin_output(splats: Splats, n: int) -> library.SkinOutput:
    """Addresses of splats, or of a gradient with respect to them."""
    frames = splats.sh_frames
    return library.SkinOutput(
        means=_address(splats.means, "means", (n, 3)),
        quats=_address(splats.quats, "quats", (n, 4)),
        scales=_address(splats.scales, "scales", (n, 3)),
        opacities=_address(splats.opacities, "opacities", (n,)),
        sh_frames=None if frames is None else _address(frames, "sh_frames", (n, 3, 3)),
    )


class NativeKernels:
    """See ``toonifygb.render.fused.Kernels``.

    Args:
        threads: threads of the engine; all available processors when ``None``.

    Raises:
        BackendError: the engine is not built or cannot be loaded.
    """

    name = "native"
    device = torch.device("cpu")

    def __init__(self, threads: int | None = None) -> None:
        self._engine = library.load()
        self.threads = threads or available_threads()

    def blend(
        self,
        base: Float[Tensor, " p"],
        deltas: Float[Tensor, "k p"],
        psi: Float[Tensor, " k"],
        *,
        out: Float[Tensor, " p"] | None = None,
    ) -> Float[Tensor, " p"]:
        """See ``Kernels.blend``."""
        k, p = deltas.shape
        half = deltas.dtype == torch.bfloat16
        out = torch.empty(p) if out is None else out
        self._engine.tgb_blend(
            _address(base, "base", (p,)),
            _address(deltas, "deltas", (k, p), torch.bfloat16 if half else torch.float32),
            half,
            _address(psi, "psi", (k,)),
            k,
            p,
            _address(out, "out", (p,)),
            self.threads,
        )
        return out

    def add_blends(
        self, out: Float[Tensor, "b q"], deltas: Float[Tensor, "k p"], psi: Float[Tensor, "b k"]
    ) -> None:
        """See ``Kernels.add_blends``."""
        (k, p), (frames, q) = deltas.shape, out.shape
        if p > q:
            raise ValueError(f"out has {q} columns, expected the {p} of deltas or more")
        self._engine.tgb_add_blends(
            _address(deltas, "deltas", (k, p)),
            _address(psi, "psi", (frames, k)),
            frames,
            k,
            p,
            _address(out, "out", (frames, q)),
            q,
            self.threads,
        )

    def adam_step(
        self,
        parameters: Float[Tensor, " p"],
        first_moment: Float[Tensor, " p"],
        second_moment: Float[Tensor, " p"],
        gradient: Float[Tensor, " p"],
        learning_rates: Float[Tensor, " p"],
        step: int,
        *,
        factor: float = 1.0,
        eps: float = EPS,
    ) -> None:
        """See ``Kernels.adam_step``."""
        shape = (parameters.numel(),)
        self._engine.tgb_adam(
            _address(parameters, "parameters", shape),
            _address(first_moment, "first_moment", shape),
            _address(second_moment, "second_moment", shape),
            _address(gradient, "gradient", shape),
            _address(learning_rates, "learning_rates", shape),
            parameters.numel(),
            _rates(step, factor, eps),
            self.threads,
        )

    def blend_adam_step(
        self,
        deltas: Float[Tensor, "k p"],
        first_moment: Float[Tensor, "k p"],
        second_moment: Float[Tensor, "k p"],
        psi: Float[Tensor, "b k"],
        gradient: Float[Tensor, "b p"],
        learning_rates: Float[Tensor, " p"],
        step: int,
        *,
        factor: float = 1.0,
        eps: float = EPS,
        scale: Float[Tensor, "k n"] | None = None,
        widths: Sequence[int] = (),
        skip_inactive: bool = False,
    ) -> None:
        """See ``Kernels.blend_adam_step``."""
        check_blend_step(deltas, scale, widths)
        (k, p), frames = deltas.shape, len(psi)
        n = p if scale is None else scale.shape[1]
        groups = (1,) if scale is None else tuple(widths)
        group_widths = (c_int32 * len(groups))(*groups)
        state = library.BlendState(
            deltas=_address(deltas, "deltas", (k, p)),
            first_moment=_address(first_moment, "first_moment", (k, p)),
            second_moment=_address(second_moment, "second_moment", (k, p)),
            psi=_address(psi, "psi", (frames, k)),
            gradient=_address(gradient, "gradient", (frames, p)),
            learning_rates=_address(learning_rates, "learning_rates", (p,)),
            scale=None if scale is None else _address(scale, "scale", (k, n)),
            widths=addressof(group_widths),
            p=p,
            k=k,
            n=n,
            groups=len(groups),
            skip_inactive=skip_inactive,
            frames=frames,
        )
        self._engine.tgb_blend_adam(state, _rates(step, factor, eps), self.threads)

    def skin(
        self, raw: GaussianParams, weights: Float[Tensor, "n 5"], transforms: Float[Tensor, "5 4 4"]
    ) -> Splats:
        """See ``Kernels.skin``."""
        n = raw.n
        splats = Splats(
            means=torch.empty(n, 3),
            quats=torch.empty(n, 4),
            scales=torch.empty(n, 3),
            opacities=torch.empty(n),
            sh=raw.sh,
            sh_frames=torch.empty(n, 3, 3),
        )
        self._engine.tgb_skin(_skin(raw, weights, transforms), _skin_output(splats, n), self.threads)
        return splats

    def skin_gradient(
        self,
        raw: GaussianParams,
        weights: Float[Tensor, "n 5"],
        transforms: Float[Tensor, "5 4 4"],
        gradient: Splats,
    ) -> GaussianParams:
        """See ``Kernels.skin_gradient``."""
        found = GaussianParams(
            torch.empty_like(raw.means),
            torch.empty_like(raw.quats),
            torch.empty_like(raw.log_scales),
            torch.empty_like(raw.opacity_logits),
            sh=gradient.sh,
        )
        fields = (found.means, found.quats, found.log_scales, found.opacity_logits)
        self._engine.tgb_skin_backward(
            _skin(raw, weights, transforms),
            _skin_output(gradient, raw.n),
            library.SkinGradient(*(field.data_ptr() for field in fields)),
            self.threads,
        )
        return found

    def place(
        self,
        frame: UInt8[Tensor, "y x 3"],
        matte: Float[Tensor, "y x"],
        background: Float[Tensor, " 3"],
        factor: int = 1,
    ) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"]]:
        """See ``Kernels.place``."""
        height, width = matte.shape
        picture = library.Picture(
            frame=_address(frame, "frame", (height, width, 3), torch.uint8),
            matte=_address(matte, "matte", (height, width)),
            background=_address(background, "background", (3,)),
            height=height,
            width=width,
        )
        small = torch.empty(height // factor, width // factor)
        color = torch.empty(*small.shape, 3)
        if not self._engine.tgb_place(picture, factor, color.data_ptr(), small.data_ptr(), self.threads):
            raise MemoryError("the engine ran out of memory for a picture")
        return color, small

    def l1_dssim(
        self,
        image: Float[Tensor, "h w 3"],
        target: Float[Tensor, "h w 3"],
        l1_weight: float = 0.8,
        dssim_weight: float = 0.2,
    ) -> tuple[Float[Tensor, ""], Float[Tensor, "h w 3"]]:
        """See ``Kernels.l1_dssim``."""
        image, target = (tensor.detach().to("cpu", torch.float32).contiguous() for tensor in (image, target))
        height, width, _ = shape = tuple(image.shape)
        gradient = torch.empty_like(image)
        loss = self._engine.tgb_l1_dssim(
            _address(image, "image", (height, width, 3)),
            _address(target, "target", shape),
            height,
            width,
            l1_weight,
            dssim_weight,
            gradient.data_ptr(),
            self.threads,
        )
        return torch.tensor(loss, dtype=torch.float32), gradient
