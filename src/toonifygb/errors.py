"""The five errors a user can meet, each with its exit code.

Sentence form: *what, with the value · what was expected · what to do*. The last part is the ``hint``.
Anything else that escapes is our bug and keeps its traceback.
"""


class ToonifyError(Exception):
    """Base of every error that is the input's or the machine's fault rather than ours.

    Args:
        message: one sentence: what happened, with the value, and what was expected.
        hint: what to do about it, a clause without a full stop; may be empty.
    """

    exit_code = 1

    def __init__(self, message: str, hint: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint

    def __str__(self) -> str:
        return f"{self.message} — hint: {self.hint}" if self.hint else self.message


class InputError(ToonifyError):
    """A file, folder or option that cannot be used as given."""

    exit_code = 2


class AssetError(ToonifyError):
    """A model file that is absent, damaged or not licensed yet."""

    exit_code = 3


class FaceError(ToonifyError):
    """No usable face where one is needed."""

    exit_code = 4


class BackendError(ToonifyError):
    """A compute backend that was asked for by name and cannot run here."""

    exit_code = 5
