#!/usr/bin/env python3
"""Tests of the Indexed Job of `echotank campaign plan --kubernetes` against the schema of Kubernetes (PyPI's kubernetes-validate, which holds it).

The program is target/release/echotank, or ECHOTANK.
"""

import copy
import os
import pathlib
import subprocess
import tempfile
import unittest

import kubernetes_validate
import yaml

ROOT = pathlib.Path(__file__).resolve().parent.parent
# `backoffLimitPerIndex` is on by default from the first on.
VERSIONS = ("1.29", kubernetes_validate.latest_version())
CAMPAIGN = """
rig = "{root}/python/examples/rigs/flat.toml"
pings = [1, 70]
shard_pings = 10
formats = ["npz"]

[set]
"sonar.model.path" = "polyline"
"sonar.model.doppler" = "stretch"
"sonar.model.synthesis" = "gridded-1d"
"""


def planned():
    """The Indexed Job of a campaign of seven shards."""
    program = os.environ.get("ECHOTANK", str(ROOT / "target/release/echotank"))
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        (folder / "campaign.toml").write_text(CAMPAIGN.format(root=ROOT))
        subprocess.run([program, "campaign", "plan", folder / "campaign.toml", "--out", folder / "out", "--cores", "2",
                        "--kubernetes", folder / "job.yaml"], check=True, stdout=subprocess.DEVNULL)
        return yaml.safe_load((folder / "job.yaml").read_text())


class IndexedJob(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.job = planned()

    def test_is_a_job_of_the_schema_with_an_index_for_each_shard(self):
        for version in VERSIONS:
            kubernetes_validate.validate(self.job, version, strict=True)
        self.assertEqual((self.job["apiVersion"], self.job["kind"]), ("batch/v1", "Job"))
        spec = self.job["spec"]
        self.assertEqual((spec["completionMode"], spec["completions"]), ("Indexed", 7))

    def test_a_mistake_in_any_part_is_found(self):
        def renamed(of, key, other):
            of[other] = of.pop(key)

        mistakes = {
            "an unknown field of the job": lambda job: renamed(job["spec"], "completions", "completion"),
            "a text for a number": lambda job: job["spec"].update(completions="seven"),
            "an unknown field of the pod": lambda job: renamed(job["spec"]["template"]["spec"], "restartPolicy", "restart"),
            "an unknown field of the container": lambda job: renamed(job["spec"]["template"]["spec"]["containers"][0], "args", "arguments"),
            "a volume without a claim": lambda job: job["spec"]["template"]["spec"]["volumes"][0].update(persistentVolumeClaim={}),
        }
        for version in VERSIONS:
            for what, change in mistakes.items():
                job = copy.deepcopy(self.job)
                change(job)
                with self.subTest(what, version=version), self.assertRaises(kubernetes_validate.ValidationError):
                    kubernetes_validate.validate(job, version, strict=True)


if __name__ == "__main__":
    unittest.main()
