"""Holds `echotank nav --json` against count.py, on any logs: compare.py ECHOTANK FILE..."""

import json
import pathlib
import subprocess
import sys

counter = pathlib.Path(__file__).with_name("count.py")
different = 0
for path in sys.argv[2:]:
    ours = json.loads(subprocess.run([sys.argv[1], "nav", path, "--json"], check=True, capture_output=True, text=True).stdout)
    words = subprocess.run([sys.executable, counter, path], check=True, capture_output=True, text=True).stdout.split()
    counts = ours["counters"]
    if "messages" in words:
        want = [int(words[words.index("messages") + 1])]
        got = [counts["sentences"]]
    else:
        want = [int(words[words.index(word) + 1]) for word in ("stamped", "backward", "sentences", "bad", "missing")]
        got = [ours["stamped"], ours["stamped_backward"], counts["sentences"], counts["bad_checksum"], counts["missing_checksum"]]
    different += got != want
    print("equal" if got == want else "DIFFERENT", path, *got, "" if got == want else want)
sys.exit(different > 0)
