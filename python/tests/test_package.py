"""The package as a whole: examples, types, memory."""

import ast
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, Callable, Dict, Set

import numpy as np
import pytest

import echotank
from conftest import FLAT, ROOT

EXAMPLES = ROOT / "python" / "examples"


@pytest.mark.parametrize(
    ("example", "args"),
    [
        ("beams.py", ["--range-m", "50"]),
        ("doppler.py", ["--pings", "3"]),
        ("soundings.py", ["--pings", "3"]),
        ("parameter_study.py", ["--pings", "2"]),
    ],
)
def test_examples_run(example: str, args: list, tmp_path: Path) -> None:
    command = [sys.executable, "-W", "error", str(EXAMPLES / example), *args]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr


def run_example(example: str, *args: Any, program: str = "") -> str:
    command = [sys.executable, "-W", "error", str(EXAMPLES / example), *map(str, args)]
    done = subprocess.run(command, env={**os.environ, "ECHOTANK": program}, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.parametrize(("scene", "sides", "rows"), [("flat", 2, 4), ("quickstart", 2, 20), ("paper", 1, 4)])
def test_the_training_set_has_labelled_pictures_of_every_scene(scene: str, sides: int, rows: int, tmp_path: Path) -> None:
    options = ["--scene", scene, "--runs", 1, "--rows", rows, "--out", tmp_path]
    assert f"{sides} pictures of {rows} x 256" in run_example("training_set.py", *options)
    with np.load(tmp_path / "run-000001.npz") as file:
        assert file["level_db"].shape == file["label"].shape == (sides, rows, 256)
        assert np.isfinite(file["level_db"]).all()
        found = set(np.unique(file["label"]))
        assert 0 in found and len(found) > 1 and found <= {0, 1, 2}, found
    assert "1 runs were there already" in run_example("training_set.py", *options)


def test_the_example_for_dask_computes_the_shards_of_a_campaign(program: str, echotank_command: Callable[..., Any], tmp_path: Path) -> None:
    campaign = tmp_path / "campaign.toml"
    campaign.write_text(f"""
rig = '{FLAT}'
pings = [1, 7]
shard_pings = 2
formats = ["npz"]

[set]
"sonar.ping.range_m" = 16.0
"sonar.model.path" = "polyline"
"sonar.model.doppler" = "stretch"
"sonar.model.synthesis" = "gridded-1d"
""")
    sweep = tmp_path / "sweep"
    echotank_command("campaign", "plan", campaign, "--out", sweep)
    said = run_example("campaign_dask.py", sweep, "--workers", 2, program=program)
    assert all(f"shard {k}: computed" in said for k in range(4)), said
    assert echotank_command("campaign", "merge", sweep, "--check").stdout.count("equal to one replay") == 2
    again = run_example("campaign_dask.py", sweep, "--workers", 2, program=program)
    assert again.count("complete already") == 4, again


def test_the_test_of_a_topside_runs(program: str) -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(EXAMPLES / "test_topside.py")]
    done = subprocess.run(command, env={**os.environ, "ECHOTANK": program}, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_stub_declares_the_members_of_every_class() -> None:
    folder = Path(echotank.__file__).parent
    assert (folder / "py.typed").is_file()
    tree = ast.parse((folder / "_native.pyi").read_text())
    declared: Dict[str, Set[str]] = {}
    for node in tree.body:
        if isinstance(node, ast.ClassDef):
            declared[node.name] = {item.name for item in node.body if isinstance(item, ast.FunctionDef)}
            for item in node.body:
                if isinstance(item, ast.FunctionDef) and not item.name.startswith("__"):
                    assert ast.get_docstring(item), f"{node.name}.{item.name}"
    for name, members in declared.items():
        native = getattr(echotank, name)
        public = {member for member in vars(native) if not member.startswith("_")}
        assert public == {member for member in members if not member.startswith("_")}, name
        for member in public:
            assert vars(native)[member].__doc__, f"{name}.{member}"


def resident_bytes() -> int:
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads /proc")
def test_memory_does_not_grow_with_the_number_of_pings() -> None:
    # Tiles of the seabed fill their memory within the first pings.
    tiles = {"scene.memory_mib": 1, "scene.seabed.density_per_m2": 1.0}
    short: Dict[str, Any] = {**tiles, "sonar.ping.range_m": 16.0, "sonar.limits.range_m": [10.0, 16.0]}
    pings = echotank.Rig(FLAT, short).pings(1, 300)
    ping_bytes, at = 0, []
    for ping in pings:
        ping_bytes = sum(samples.nbytes for samples in ping.elements.values()) + ping.beams.nbytes
        if ping.number in (100, 300):
            at.append(resident_bytes())
    # A leak of one ping in ten would show.
    assert at[1] - at[0] < 2 * ping_bytes + (4 << 20), at
