"""A labelled training set for the segmentation of side-scan pictures.

Each picture is one side of a run of pings: rows are pings, columns are slant range. Its label names the contents of every sample: 0 seabed,
1 shadow, 2 target. Seeds, ranges and targets vary from run to run; each run has its own scene.

    python training_set.py --runs 8 --out out/training.npz
"""

import argparse
import tempfile
import time
from pathlib import Path
from typing import Iterator, List, Tuple

import numpy as np

import echotank

RIG = Path(__file__).resolve().parent / "rigs" / "flat.toml"
SEABED, SHADOW, TARGET = 0, 1, 2


def targets(random: np.random.Generator, length_m: float) -> str:
    """A file of random boxes, spheres and cylinders on both sides of the track."""
    text = ""
    for k in range(random.integers(4, 9)):
        north_m = random.uniform(0, length_m)
        east_m = random.choice([-1, 1]) * random.uniform(6, 28)
        shape = random.choice(["box", "sphere", "cylinder"])
        size = {
            "box": f"size_m = [{random.uniform(1, 4):.2f}, {random.uniform(0.5, 2):.2f}, {random.uniform(0.5, 2):.2f}]",
            "sphere": f"radius_m = {random.uniform(0.3, 1):.2f}",
            "cylinder": f"radius_m = {random.uniform(0.2, 0.6):.2f}\nlength_m = {random.uniform(1, 4):.2f}\nelevation_deg = 0.0",
        }[shape]
        text += f'[[target]]\nname = "{shape}-{k}"\nshape = "{shape}"\nnorth_m = {north_m:.2f}\neast_m = {east_m:.2f}\n'
        text += f"{size}\nlambert_db = {random.uniform(-18, -8):.1f}\n"
        text += "" if shape == "sphere" else f"heading_deg = {random.uniform(0, 360):.0f}\n"
        text += "\n"
    return text


def labels(mask: echotank.Mask) -> np.ndarray:
    """Labels of a line: uint8 (samples,)."""
    return np.where(mask.target > 0, TARGET, np.where(mask.shadow > 0, SHADOW, SEABED)).astype(np.uint8)


def resized(row: np.ndarray, columns: int) -> np.ndarray:
    """The strongest value in each column: amplitudes keep their peaks, and labels their rarest class."""
    edges = np.linspace(0, len(row), columns + 1).astype(int)
    return np.maximum.reduceat(row, edges[:-1])


def run(seed: int, pings: int, columns: int) -> Iterator[Tuple[np.ndarray, np.ndarray]]:
    """Two pictures and their labels, port and starboard: (pings, columns) each, levels in dB re 1 V."""
    random = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "targets.toml"
        file.write_text(targets(random, 2.0 * pings / 5.0))
        rig = echotank.Rig(
            RIG,
            {
                "scene.seed": seed,
                "scene.targets": str(file),
                "scene.seabed.depth_m": round(random.uniform(8, 20), 2),
                "scene.seabed.bottom": str(random.choice(["mud", "silt", "sand", "gravel"])),
                "sonar.ping.range_m": round(random.uniform(30, 50), 1),
                "sonar.receiver.seed": seed,
            },
        )
        pictures: dict = {"port": [], "starboard": []}
        masks: dict = {"port": [], "starboard": []}
        # Only lines are needed: without elements, the program may compute beams directly.
        for ping in rig.pings(1, pings, elements=False, masks=True, threads=1):
            for side, line in ping.lines.items():
                pictures[side].append(resized(line, columns))
                masks[side].append(resized(labels(ping.masks[side]), columns))
    for side in pictures:
        level = 20 * np.log10(np.maximum(np.array(pictures[side]), 1e-9))
        yield level.astype(np.float32), np.array(masks[side])


def main() -> Tuple[np.ndarray, np.ndarray]:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=8)
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--pings", type=int, default=64)
    parser.add_argument("--columns", type=int, default=256)
    parser.add_argument("--out", type=Path, default=Path("out/training.npz"))
    args = parser.parse_args()
    began = time.perf_counter()
    pictures: List[np.ndarray] = []
    masks: List[np.ndarray] = []
    for seed in range(args.first_seed, args.first_seed + args.runs):
        for picture, mask in run(seed, args.pings, args.columns):
            pictures.append(picture)
            masks.append(mask)
    took_s = time.perf_counter() - began
    args.out.parent.mkdir(parents=True, exist_ok=True)
    level, label = np.array(pictures), np.array(masks)
    np.savez_compressed(args.out, level_db=level, label=label)
    shares = [100 * (label == of).mean() for of in (SEABED, SHADOW, TARGET)]
    print(f"{len(level)} pictures of {args.pings} x {args.columns} in {took_s:.1f} s: {len(level) / took_s:.2f} a second")
    print("seabed {:.1f} %, shadow {:.1f} %, target {:.2f} %".format(*shares))
    print(f"wrote {args.out}: level_db {level.shape}, label {label.shape}")
    return level, label


if __name__ == "__main__":
    main()
