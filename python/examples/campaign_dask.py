"""A campaign on Dask: its workers compute the shards that `echotank campaign run` would, and the shards are merged.

Each task runs `echotank campaign run FOLDER --shard K`. A shard that is complete already ends at once, so that this program may be ended and started
again. A task whose worker is lost runs again on another. With `--scheduler`, the workers must reach the folder and the program by the same paths.

    echotank campaign plan campaign.toml --out sweep
    python campaign_dask.py sweep                                      workers on this computer
    python campaign_dask.py sweep --scheduler tcp://10.0.0.1:8786      those of a scheduler
"""

import argparse
import json
import os
import shutil
import subprocess
import time
from pathlib import Path
from typing import List

from dask.distributed import Client, LocalCluster, as_completed


def compute(program: str, folder: str, shard: int, threads: int) -> str:
    """Computes a shard on the worker that calls it; returns what the program says."""
    command = [program, "campaign", "run", folder, "--shard", str(shard), "--threads", str(threads)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(done.stderr.strip())
    return done.stdout.strip()


def main() -> List[str]:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="of `echotank campaign plan`")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="on this computer")
    parser.add_argument("--threads", type=int, default=1, help="of each shard")
    parser.add_argument("--scheduler", help="address of a Dask scheduler, instead of workers on this computer")
    args = parser.parse_args()
    program = os.environ.get("ECHOTANK") or shutil.which("echotank")
    if not program:
        parser.error("ECHOTANK does not name the program, and it is not on the path")
    folder = str(args.folder.resolve())
    shards = len(json.loads((args.folder / "campaign.json").read_text())["shards"])

    local = None
    if not args.scheduler:
        local = LocalCluster(n_workers=args.workers, threads_per_worker=1, dashboard_address=None)
    began = time.perf_counter()
    said: List[str] = []
    try:
        with Client(local or args.scheduler) as client:
            # Not pure: whether a shard is complete depends on the disk, not on the arguments.
            tasks = client.map(lambda shard: compute(program, folder, shard, args.threads), range(shards), pure=False, retries=2)
            for task in as_completed(tasks):
                said.append(task.result())
                print(f"{len(said)} of {shards}: {said[-1]}")
    finally:
        if local:
            local.close()
    took_s = time.perf_counter() - began
    print(f"{shards} shards in {took_s:.1f} s: {shards / took_s:.2f} a second")
    subprocess.run([program, "campaign", "merge", folder], check=True)
    return said


if __name__ == "__main__":
    main()
