"""Exceptions, and the entries of their lists."""

from typing import NamedTuple, Optional, Tuple


class EchotankError(Exception):
    """Base class of the errors of this package."""


class EchotankWarning(UserWarning):
    """Something that the package worked around, such as an ignored part of the navigation."""


class Problem(NamedTuple):
    """One problem of a configuration. ``str()`` is its line as ``echotank check`` prints it."""

    #: Path of the key, such as ``sonar[0].pulse.duration_ms``; empty for a file that cannot be read.
    path: str
    #: Line in the file, from 1; None with overrides.
    line: Optional[int]
    #: Value as written; empty without a value.
    value: str
    #: The violated rule.
    rule: str
    #: Proposed correction.
    hint: Optional[str]
    #: The whole problem as one line.
    text: str

    def __str__(self) -> str:
        return self.text


class ConfigurationError(EchotankError, ValueError):
    """A wrong configuration. ``str()`` prints every problem, as ``echotank check`` does."""

    #: Problems in the order of their lines; empty where the text alone says what is wrong.
    problems: Tuple[Problem, ...]

    def __init__(self, text: str, problems: Tuple[Problem, ...] = ()) -> None:
        super().__init__(text, problems)
        self.problems = tuple(problems)

    def __str__(self) -> str:
        return str(self.args[0])


class RefusedError(EchotankError, ValueError):
    """A refused setting, fault or argument. The text names key, value and rule; nothing has changed."""


class RecordingError(EchotankError, ValueError):
    """A file that is not a recording of this program, or a damaged one."""


class Finding(NamedTuple):
    """Something that a valid rig does otherwise than is probably meant."""

    #: Kind, such as ``"too slow"`` or ``"sees no seabed"``.
    kind: str
    #: What happens, with numbers.
    text: str
    #: What to change.
    remedy: str
