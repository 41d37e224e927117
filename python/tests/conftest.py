"""Shared parts of the tests. ECHOTANK names the program whose replay is compared; without it, that of the release build."""

import os
import subprocess
from pathlib import Path
from typing import Any, Callable, Dict, List

import pytest

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = ROOT / "hil-configs"
FLAT = ROOT / "python" / "examples" / "rigs" / "flat.toml"
#: Every kind of output in short pings: side-scan lines of both sides, and a fan with soundings.
SHORT = {"sonar.ping.range_m": 20.0}


@pytest.fixture(scope="session")
def program() -> str:
    name = os.environ.get("ECHOTANK", str(ROOT / "target" / "release" / "echotank"))
    assert Path(name).is_file(), f"{name} is not built; ECHOTANK names another"
    return name


@pytest.fixture(scope="session")
def echotank_command(program: str) -> Callable[..., "subprocess.CompletedProcess[str]"]:
    def run(*args: Any, check: bool = True) -> "subprocess.CompletedProcess[str]":
        command = [program, *map(str, args)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=600)
        assert not check or done.returncode == 0, done.stderr
        return done

    return run


@pytest.fixture(scope="session")
def replay(echotank_command: Callable[..., Any], tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Replays pings of a rig into a folder of their own."""

    def run(rig: Path, pings: str, formats: str, overrides: Dict[str, Any], *more: str) -> Path:
        out = tmp_path_factory.mktemp("replay")
        changes: List[str] = []
        for key, value in overrides.items():
            changes += ["--set", f"{key}={str(value).lower() if isinstance(value, bool) else value}"]
        echotank_command("replay", rig, "--out", out, "--pings", pings, "--formats", formats, "--quiet", *changes, *more)
        return out

    return run
