"""Readers of recordings."""

import json
import os
import re
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Callable, Dict, Iterator, List, Optional, Sequence, Tuple, Union

import numpy as np
import numpy.typing as npt

from ._errors import RecordingError
from ._native import Mask, Soundings, read_records

_Array = npt.NDArray[Any]

# The sizes of `ds64` of RF64, which replace those of 32 bits.
_RF64 = 0xFFFFFFFF


@dataclass(eq=False)
class RecordedPing:
    """One ping of a recording, with the attributes of a computed :class:`echotank.Ping` as far as the format holds them."""

    #: Number of the ping, from 1.
    number: int
    #: Start of the pulse, nanoseconds since 1970 UTC; None if the format does not hold it.
    utc_ns: Optional[int] = None
    #: Sample rate, hertz; 0 if unknown.
    sample_rate_hz: float = 0.0
    #: Time of the first sample of ``elements`` and ``beams`` after the start of the pulse, seconds.
    first_sample_s: float = 0.0
    #: Sound speed, metres per second; 0 if unknown.
    sound_speed_m_per_s: float = 0.0
    #: complex64 (elements, samples) by the name of the array, or "receive" where the format has no names.
    elements: Dict[str, _Array] = field(default_factory=dict)
    #: complex64 (beams, samples).
    beams: _Array = field(default_factory=lambda: np.zeros((0, 0), np.complex64))
    #: float64 (beams,), radians, positive to starboard.
    beam_angle_rad: _Array = field(default_factory=lambda: np.zeros(0))
    #: float32 (samples,) by side; sample 0 is the start of the pulse.
    lines: Dict[str, _Array] = field(default_factory=dict)
    #: Bottom detections.
    soundings: Optional[Soundings] = None
    #: Labels of the lines by side, or of the beams under "beams".
    masks: Dict[str, Any] = field(default_factory=dict)
    #: Ground truth, as in ``truth.jsonl``.
    truth: Dict[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        held = [name for name in ("elements", "lines", "masks", "truth") if getattr(self, name)]
        held += ["beams"] if len(self.beams) else []
        held += ["soundings"] if self.soundings is not None and len(self.soundings) else []
        return f"RecordedPing({self.number}: {', '.join(held)})"


@dataclass(eq=False)
class Recording(Sequence[RecordedPing]):
    """The pings of a recording, in the order of the file."""

    path: Path
    #: "npz", "zarr", "masks", "s7k", "jsf", "xtf", "svlog", "sigmf", "wav" or "truth".
    format: str
    #: Unit of the samples: "V" (volts, rms), "counts", or "full scale" (an envelope of the receiver's ``full_scale_v`` is 1).
    unit: str
    pings: List[RecordedPing]
    #: Of a ``.wav``: float32 (channels, samples), instantaneous, from the start of the first pulse on.
    signal: Optional[_Array] = None
    #: Of a ``.wav``: sample rate of ``signal``, hertz.
    signal_rate_hz: float = 0.0

    def __len__(self) -> int:
        return len(self.pings)

    def __getitem__(self, index: Any) -> Any:
        return self.pings[index]

    def __iter__(self) -> Iterator[RecordedPing]:
        return iter(self.pings)

    def __repr__(self) -> str:
        return f"Recording({self.path}, {self.format}, {len(self.pings)} pings, {self.unit})"


def read(path: Union[str, "os.PathLike[str]"]) -> Recording:
    """Read a recording of ``echotank run`` or ``echotank replay``.

    The format follows from the contents: ``.npz`` (samples or masks), ``.zarr``, ``.s7k``, ``.jsf``, ``.xtf``, ``.svlog``, SigMF (either file),
    ``.wav`` and ``truth.jsonl``. A ``.mcap`` is left to the package ``mcap``.

    Args:
        path: The file, or the folder of a ``.zarr``.

    Returns:
        The pings, with the attributes that the format holds.

    Raises:
        RecordingError: The file is of no such format, or damaged.
        OSError: The file cannot be opened.
    """
    path = Path(path)
    reader: Optional[Callable[[Path], Recording]] = _zarr
    if not path.is_dir():
        with open(path, "rb") as file:
            head = file.read(12)
        if head.startswith(b"\x89MCAP"):
            raise RecordingError(f"{path}: is an MCAP file: read it with the packages mcap and mcap-ros2-support")
        reader = _reader(path, head)
        if reader is None:
            raise RecordingError(f"{path}: is of no known format: it begins with {head!r}")
    elif not (path / "zarr.json").is_file():
        raise RecordingError(f"{path}: is a folder without zarr.json; name a file, or a Zarr store of format 3")
    try:
        return reader(path)
    except (KeyError, IndexError, ValueError, TypeError, EOFError, zipfile.BadZipFile) as error:
        if isinstance(error, RecordingError):
            raise
        raise RecordingError(f"{path}: is damaged or not of this program: {error!r}") from error
    except FileNotFoundError as error:
        raise RecordingError(f"{path}: {error.filename} is missing") from error


def _reader(path: Path, head: bytes) -> Optional[Callable[[Path], Recording]]:
    if path.suffix in (".sigmf-meta", ".sigmf-data"):
        return _sigmf
    if head.startswith(b"PK"):
        return _npz
    if head[:4] in (b"RIFF", b"RF64"):
        return _wav
    if head.startswith(b"\x01\x16"):
        return lambda path: _records(path, "jsf", "V")
    if head.startswith(b"BR"):
        return lambda path: _records(path, "svlog", "V")
    if head.startswith(b"\x7b\x01"):
        return lambda path: _records(path, "xtf", "V")
    if head[4:8] == b"\xff\xff\x00\x00":
        return lambda path: _records(path, "s7k", "counts")
    if head.startswith(b"{"):
        return _truth
    return None


def _records(path: Path, form: str, unit: str) -> Recording:
    pings = [RecordedPing(**ping) for ping in read_records(path, form)]
    return Recording(path, form, unit, pings)


def _side(number: int) -> str:
    return "port" if number < 0 else "starboard"


def _npz(path: Path) -> Recording:
    # An open file that is damaged would stay open.
    with open(path, "rb") as data, np.load(data, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    if "target" in arrays:
        return _masks(path, arrays)
    plan = json.loads(str(arrays["plan"]))
    names = [array["name"] for array in plan["receive"]]
    rows = {name: np.flatnonzero(arrays["element_array"] == k) for k, name in enumerate(names)}
    slices = {name: slice(of[0], of[-1] + 1) for name, of in rows.items() if len(of)}
    sides = [_side(side) for side in arrays["line_side"]]
    angles = np.broadcast_to(arrays["beam_angle_rad"], (len(arrays["ping_number"]), arrays["beams"].shape[1]))
    pings = []
    for p, number in enumerate(arrays["ping_number"]):
        pings.append(
            RecordedPing(
                number=int(number),
                utc_ns=int(arrays["ping_utc_ns"][p]),
                sample_rate_hz=float(arrays["sample_rate_hz"]),
                first_sample_s=float(arrays["first_sample_s"]),
                sound_speed_m_per_s=float(arrays["sound_speed_m_per_s"]),
                elements={name: arrays["iq_by_element"][p, of] for name, of in slices.items()},
                beams=arrays["beams"][p],
                beam_angle_rad=np.array(angles[p]),
                lines={side: arrays["lines"][p, k] for k, side in enumerate(sides)},
                soundings=_soundings(arrays, angles, p),
            )
        )
    return Recording(path, "npz", "V", pings)


def _soundings(arrays: Dict[str, _Array], angles: _Array, p: int) -> Optional[Soundings]:
    if "sounding_method" not in arrays:
        return None
    method = arrays["sounding_method"][p]
    beam = np.flatnonzero(method)
    return Soundings(
        beam=beam.astype(np.int64),
        angle_rad=angles[p][beam],
        twtt_s=arrays["sounding_twtt_s"][p][beam],
        error_s=arrays["sounding_error_s"][p][beam],
        level_v=arrays["sounding_level_v"][p][beam] if "sounding_level_v" in arrays else np.full(len(beam), np.nan),
        method=method[beam],
    )


def _zarr(path: Path) -> Recording:
    group = json.loads((path / "zarr.json").read_text(encoding="utf-8"))
    metadata = group["consolidated_metadata"]["metadata"]
    arrays = {name: _zarr_array(path / name, of) for name, of in metadata.items()}
    about = group["attributes"]
    names = metadata["element_array"]["attributes"]["names"]
    rows = {name: arrays["element_array"] == k for k, name in enumerate(names)}
    sides = [_side(side) for side in arrays.get("line_side", [])]
    pings = []
    for p, number in enumerate(arrays["ping"]):
        ping = RecordedPing(
            number=int(number),
            utc_ns=int(arrays["time"][p]),
            sample_rate_hz=float(about["sample_rate_hz"]),
            first_sample_s=float(about["first_sample_s"]),
            sound_speed_m_per_s=float(about["sound_speed_m_per_s"]),
            lines={side: arrays["lines"][p, k] for k, side in enumerate(sides)},
        )
        if "elements" in arrays:
            ping.elements = {name: arrays["elements"][p, of] for name, of in rows.items()}
        if "beams" in arrays:
            ping.beams, ping.beam_angle_rad = arrays["beams"][p], arrays["beam_angle_rad"][p]
        ping.soundings = _soundings(arrays, arrays.get("beam_angle_rad", np.zeros((0, 0))), p)
        mask = ("target", "shadow", "depth_m")
        if "line_target" in arrays:
            ping.masks = {side: Mask(*(arrays["line_" + m][p, k] for m in mask)) for k, side in enumerate(sides)}
        if "beam_target" in arrays:
            ping.masks["beams"] = Mask(*(arrays["beam_" + m][p] for m in mask))
        pings.append(ping)
    return Recording(path, "zarr", "V", pings)


def _zarr_array(folder: Path, metadata: Dict[str, Any]) -> _Array:
    """An array of little-endian values in chunks along its first dimension."""
    if [codec["name"] for codec in metadata["codecs"]] != ["bytes"]:
        raise ValueError(f"{folder.name}: has compressed chunks, which xarray reads")
    shape, chunk = metadata["shape"], metadata["chunk_grid"]["configuration"]["chunk_shape"]
    dtype = np.dtype(metadata["data_type"]).newbyteorder("<")
    zeros = ["0"] * (len(shape) - 1)
    parts = [np.fromfile(folder.joinpath("c", str(k), *zeros), dtype) for k in range(-(-shape[0] // chunk[0]))]
    return np.concatenate(parts).reshape(shape)


def _masks(path: Path, arrays: Dict[str, _Array]) -> Recording:
    def mask(p: int, of: Any) -> Mask:
        return Mask(*(arrays[name][p][of] for name in ("target", "shadow", "depth_m")))

    pings = []
    for p, number in enumerate(arrays["ping_number"]):
        if "line_side" in arrays:
            masks = {_side(side): mask(p, k) for k, side in enumerate(arrays["line_side"])}
        else:
            masks = {"beams": mask(p, slice(None))}
        pings.append(RecordedPing(number=int(number), masks=masks))
    return Recording(path, "masks", "", pings)


def _sigmf(path: Path) -> Recording:
    meta = json.loads(path.with_suffix(".sigmf-meta").read_text(encoding="utf-8"))
    total = meta["global"]
    channels = int(total["core:num_channels"])
    scale = re.search(r"32767 counts are (\S+) V", total.get("core:description", ""))
    volts = float(scale.group(1)) / 32767 if scale else 1 / 32767
    counts = np.fromfile(path.with_suffix(".sigmf-data"), "<i2")
    counts = counts[: len(counts) // (2 * channels) * 2 * channels].reshape(-1, channels, 2)
    starts = {c["core:sample_start"]: c for c in meta["captures"]}
    pings = []
    for note in meta["annotations"]:
        start, count = note["core:sample_start"], note["core:sample_count"]
        pairs = counts[start : start + count].astype(np.float32) * np.float32(volts)
        iq = pairs[..., 0] + 1j * pairs[..., 1]
        number = int(note["core:label"].split()[-1])
        # The capture holds the instant of the first sample, not that of the pulse.
        time = starts[start].get("core:datetime")
        pings.append(
            RecordedPing(
                number=number,
                utc_ns=int(np.datetime64(time.rstrip("Z"), "ns").astype(np.int64)) if time else None,
                sample_rate_hz=float(total["core:sample_rate"]),
                elements={"receive": np.ascontiguousarray(iq.T.astype(np.complex64))},
            )
        )
    return Recording(path, "sigmf", "V" if scale else "full scale", pings)


def _chunks(data: bytes) -> Iterator[Tuple[bytes, bytes]]:
    """Chunks of a WAV file. The data of an unfinished or large file reach to its end."""
    at, sizes = 12, {}
    while at + 8 <= len(data):
        name, size = data[at : at + 4], int.from_bytes(data[at + 4 : at + 8], "little")
        if name == b"ds64":
            sizes[b"data"] = int.from_bytes(data[at + 16 : at + 24], "little")
        size = sizes.get(name, size) if size == _RF64 else size
        yield name, data[at + 8 : at + 8 + size]
        at += 8 + size + size % 2


def _wav(path: Path) -> Recording:
    chunks = dict(_chunks(path.read_bytes()))
    form = chunks[b"fmt "]
    channels, rate = int.from_bytes(form[2:4], "little"), int.from_bytes(form[4:8], "little")
    is_float = int.from_bytes(form[24:26], "little") == 3
    samples = np.frombuffer(chunks[b"data"], "<f4" if is_float else "<i2")
    samples = samples[: len(samples) // channels * channels].reshape(-1, channels).T
    signal = samples.astype(np.float32) / np.float32(1 if is_float else 32767)
    return Recording(path, "wav", "full scale", [], np.ascontiguousarray(signal), float(rate))


def _truth(path: Path) -> Recording:
    pings = []
    for line in path.read_text(encoding="utf-8").splitlines():
        truth = json.loads(line)
        pings.append(
            RecordedPing(
                number=truth["ping_number"],
                utc_ns=truth["utc_ns"],
                first_sample_s=truth["plan"]["first_sample_s"],
                sound_speed_m_per_s=truth["plan"]["sound_speed_m_per_s"],
                truth=truth,
            )
        )
    return Recording(path, "truth", "", pings)
