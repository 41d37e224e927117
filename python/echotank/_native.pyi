"""Types of the native part. The classes are members of the package ``echotank``."""

import os
from pathlib import Path
from typing import Any, Dict, Iterator, List, Optional, Tuple, Union

import numpy as np
import numpy.typing as npt

from ._errors import Finding

__version__: str

_Path = Union[str, "os.PathLike[str]"]

class Settings:
    """Settings with which a ping was made."""

    @property
    def range_m(self) -> float:
        """Maximum slant range, metres."""
    @property
    def max_ping_rate_hz(self) -> float:
        """Maximum ping rate, hertz."""
    @property
    def source_level_db(self) -> float:
        """Source level, dB re 1 uPa at 1 m."""
    @property
    def gain_db(self) -> float:
        """Receiver gain, dB."""
    @property
    def pulse_duration_s(self) -> float:
        """Pulse length, seconds."""

class Pose:
    """Pose of the platform's reference point at the start of the pulse."""

    @property
    def position_m(self) -> Tuple[float, float, float]:
        """North, east, down from the world's origin, metres."""
    @property
    def velocity_m_per_s(self) -> Tuple[float, float, float]:
        """North, east, down, metres per second."""
    @property
    def roll_deg(self) -> float:
        """Roll, degrees, positive starboard down."""
    @property
    def pitch_deg(self) -> float:
        """Pitch, degrees, positive bow up."""
    @property
    def heading_deg(self) -> float:
        """Heading, degrees clockwise from true north."""
    @property
    def latitude_deg(self) -> float:
        """WGS84 latitude, degrees."""
    @property
    def longitude_deg(self) -> float:
        """WGS84 longitude, degrees."""

class Soundings:
    """Bottom detections of one ping, as columns."""

    def __init__(
        self,
        beam: npt.NDArray[np.int64],
        angle_rad: npt.NDArray[np.float64],
        twtt_s: npt.NDArray[np.float64],
        error_s: npt.NDArray[np.float64],
        level_v: npt.NDArray[np.float64],
        method: npt.NDArray[np.uint8],
    ) -> None: ...
    def __len__(self) -> int: ...
    @property
    def beam(self) -> npt.NDArray[np.int64]:
        """Index of the beam, (soundings,)."""
    @property
    def angle_rad(self) -> npt.NDArray[np.float64]:
        """Angle from the boresight, (soundings,), radians, positive to starboard."""
    @property
    def twtt_s(self) -> npt.NDArray[np.float64]:
        """Two-way travel time from the start of the pulse, (soundings,), seconds."""
    @property
    def error_s(self) -> npt.NDArray[np.float64]:
        """Predicted standard deviation of the travel time, (soundings,), seconds."""
    @property
    def level_v(self) -> npt.NDArray[np.float64]:
        """Level of the echo, (soundings,), volts (rms); in counts where a recording holds counts, NaN where it holds none."""
    @property
    def method(self) -> npt.NDArray[np.uint8]:
        """Method of the detection, (soundings,): 1 amplitude, 2 phase."""

class Mask:
    """Labels of samples: of one side-scan line (samples,), or of all beams (beams, samples)."""

    def __init__(self, target: npt.NDArray[Any], shadow: npt.NDArray[Any], depth_m: npt.NDArray[Any]) -> None: ...
    @property
    def target(self) -> npt.NDArray[np.uint16]:
        """Target with most of the energy: 1 is the first target of the scene, 0 none."""
    @property
    def shadow(self) -> npt.NDArray[np.uint8]:
        """1 where ground on the beam axis is not insonified and no target is labelled."""
    @property
    def depth_m(self) -> npt.NDArray[np.float32]:
        """Depth of the ground on the beam axis, metres below the world's origin; NaN where absent."""

class Ping:
    """One computed ping. Its arrays belong to it: they stay as they are when the next ping is computed."""

    @property
    def sonar(self) -> str:
        """Name of the sonar."""
    @property
    def number(self) -> int:
        """Number of the ping, from 1."""
    @property
    def utc_ns(self) -> int:
        """Start of the pulse, nanoseconds since 1970 UTC."""
    @property
    def stamp_utc_ns(self) -> int:
        """Time stamp of the records (``nav.stamp``), nanoseconds since 1970 UTC."""
    @property
    def elements(self) -> Dict[str, npt.NDArray[np.complexfloating[Any, Any]]]:
        """Element samples of each receive array by its name: complex64 (elements, samples), volts (rms) of the complex envelope about
        ``center_frequency_hz``; complex128 with ``double=True``. Sample k lies at ``first_sample_s + k / sample_rate_hz``."""
    @property
    def beams(self) -> npt.NDArray[np.complex64]:
        """Beams of the fan after the matched filter: (beams, samples), volts (rms); no beams without a fan."""
    @property
    def beam_angle_rad(self) -> npt.NDArray[np.float64]:
        """Angles of the beams from the boresight: (beams,), radians, positive to starboard."""
    @property
    def beam_width_rad(self) -> npt.NDArray[np.float64]:
        """-3 dB widths of the beams across the track: (beams,), radians."""
    @property
    def lines(self) -> Dict[str, npt.NDArray[np.float32]]:
        """Side-scan lines by side, "port" and "starboard": (samples,), envelope in volts (rms). Sample 0 is the start of the pulse."""
    @property
    def more_lines(self) -> List[Dict[str, npt.NDArray[np.float32]]]:
        """Side-scan lines of each further pulse, as ``lines``. Sample 0 is the start of that pulse."""
    @property
    def soundings(self) -> Soundings:
        """Bottom detections of the fan."""
    @property
    def pose(self) -> Pose:
        """Pose of the platform at the start of the pulse."""
    @property
    def settings(self) -> Settings:
        """Settings with which the ping was made."""
    @property
    def sample_rate_hz(self) -> float:
        """Sample rate of the receiver, hertz."""
    @property
    def first_sample_s(self) -> float:
        """Time of sample 0 after the start of the pulse, seconds."""
    @property
    def time_s(self) -> npt.NDArray[np.float64]:
        """Times of the samples of ``elements`` and ``beams`` after the start of the pulse: (samples,), seconds."""
    @property
    def center_frequency_hz(self) -> float:
        """Centre frequency of the pulse, hertz."""
    @property
    def sound_speed_m_per_s(self) -> float:
        """Sound speed of the water, metres per second."""
    @property
    def element_position_m(self) -> Dict[str, npt.NDArray[np.float64]]:
        """Positions of the elements of each receive array at the start of the pulse: (elements, 3), north, east, down, metres."""
    @property
    def transmit_position_m(self) -> Dict[str, npt.NDArray[np.float64]]:
        """Position of each transmit array at the start of the pulse: (3,), north, east, down, metres."""
    @property
    def masks(self) -> Dict[str, Mask]:
        """Labels of the side-scan lines by side, arrays of (samples,). Needs ``masks=True``."""
    @property
    def beam_mask(self) -> Mask:
        """Labels of the beams, arrays of (beams, samples). Needs ``masks=True``."""
    @property
    def truth(self) -> Dict[str, Any]:
        """Ground truth of the ping: the line of ``truth.jsonl`` as a dictionary."""
    @property
    def plan(self) -> Dict[str, Any]:
        """The sonar with its arrays, receiver and pulse, and the plan of the ping: ``plan`` of ``pings.npz`` as a dictionary."""

class Pings(Iterator[Ping]):
    """Pings of a rig, computed one after another. Made by :meth:`Rig.pings`."""

    def __iter__(self) -> Pings: ...
    def __next__(self) -> Ping: ...
    def __length_hint__(self) -> int:
        """Expected number of pings, for progress bars; 0 if it is unknown."""
    @property
    def skipped(self) -> int:
        """Number of pings left out so far because the navigation has a gap."""
    def settings(self, sonar: Optional[str] = None) -> Settings:
        """Settings of the next ping of a sonar; of the first one without a name."""
    def set(
        self,
        sonar: Optional[str] = None,
        *,
        range_m: Optional[float] = None,
        max_ping_rate_hz: Optional[float] = None,
        source_level_db: Optional[float] = None,
        gain_db: Optional[float] = None,
        pulse_duration_s: Optional[float] = None,
    ) -> None:
        """Changes settings from the next ping on. Raises RefusedError outside ``sonar.limits``."""
    def inject(self, kind: str, **keys: Any) -> int:
        """Injects a fault from the next ping on and returns its number. The keys are those of ``[[fault]]``."""
    def clear_faults(self, fault: Optional[int] = None) -> int:
        """Removes one fault by its number, or all faults. Returns how many were removed."""
    def take_injections(self) -> List[Dict[str, Any]]:
        """The faults that were injected since the last call, as in ``faults-*.jsonl``."""

class Rig:
    """A rig: water, navigation, scene and sonars, from one configuration file."""

    def __init__(
        self, path: _Path, overrides: Optional[Dict[str, Any]] = None, *, nav: Optional[_Path] = None
    ) -> None: ...
    @property
    def path(self) -> Path:
        """The configuration file."""
    @property
    def sonars(self) -> List[str]:
        """Names of the sonars, in the order of the configuration."""
    def summary(self) -> str:
        """Derived values of the configuration, as ``echotank check`` prints them."""
    def check(self) -> List[Finding]:
        """Findings of the rig, as ``echotank check`` reports them. An empty list is the verdict "works"."""
    def pings(
        self,
        first: int = 1,
        count: Optional[int] = None,
        *,
        elements: bool = True,
        masks: bool = False,
        double: bool = False,
        threads: Optional[int] = None,
    ) -> Pings:
        """An iterator over pings in the order of time, with the bits of ``echotank replay``."""

def read_records(path: _Path, format: str) -> List[Dict[str, Any]]: ...
