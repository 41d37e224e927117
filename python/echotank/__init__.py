"""Pings of the sonar emulator Echotank as NumPy arrays.

Example:
    >>> import echotank
    >>> rig = echotank.Rig("rig.toml", overrides={"sonar.ping.range_m": 80})
    >>> for ping in rig.pings(first=1, count=100):
    ...     samples = ping.elements["port"]     # complex64 (elements, samples), volts (rms)
    ...     beams = ping.beams                  # complex64 (beams, samples), volts (rms)

The samples have the bits of ``echotank replay``. World coordinates are north, east, down in metres. Pings are numbered from 1.
"""

from ._errors import (
    ConfigurationError,
    EchotankError,
    EchotankWarning,
    Finding,
    Problem,
    RecordingError,
    RefusedError,
)
from ._native import Mask, Ping, Pings, Pose, Rig, Settings, Soundings, __version__
from ._read import RecordedPing, Recording, read

__all__ = [
    "ConfigurationError",
    "EchotankError",
    "EchotankWarning",
    "Finding",
    "Mask",
    "Ping",
    "Pings",
    "Pose",
    "Problem",
    "RecordedPing",
    "Recording",
    "RecordingError",
    "RefusedError",
    "Rig",
    "Settings",
    "Soundings",
    "__version__",
    "read",
]
