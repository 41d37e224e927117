//! Tests of `echotank campaign`: shards, workers that end, mixtures, and the files of schedulers.

use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::{command, ended, run, run_well};

/// Overrides for short pings with few methods to design.
const FIXED: &str = r#"
[set]
"sonar.ping.range_m" = 16.0
"sonar.model.path" = "polyline"
"sonar.model.doppler" = "stretch"
"sonar.model.synthesis" = "gridded-1d"
"sonar.model.error_check" = false
"#;

/// A planned campaign in a folder of its own.
struct Planned {
    folder: tempfile::TempDir,
}

impl Planned {
    fn new(more: &str) -> Self {
        Self::of(
            "python/examples/rigs/flat.toml",
            "pings = [1, 7]\nshard_pings = 3",
            more,
        )
    }

    fn of(rig: &str, pings: &str, more: &str) -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let rig = echotank_testing::repository().join(rig);
        let text = format!("rig = {rig:?}\n{pings}\n{more}");
        std::fs::write(folder.path().join("campaign.toml"), text).expect("written");
        let planned = Self { folder };
        run_well("campaign", planned.plan_arguments());
        planned
    }

    fn plan_arguments(&self) -> Vec<PathBuf> {
        let file = self.folder.path().join("campaign.toml");
        ["plan".into(), file, "--out".into(), self.out()].into()
    }

    fn out(&self) -> PathBuf {
        self.folder.path().join("out")
    }

    fn manifest(&self) -> Value {
        let text = std::fs::read_to_string(self.out().join("campaign.json")).expect("a manifest");
        serde_json::from_str(&text).expect("JSON")
    }

    fn arguments(&self, subcommand: &str, more: &[&str]) -> Vec<PathBuf> {
        let more = more.iter().map(PathBuf::from);
        [subcommand.into(), self.out()]
            .into_iter()
            .chain(more)
            .collect()
    }

    fn shard(&self, number: usize) -> PathBuf {
        self.out().join(format!("shards/{number:06}"))
    }
}

fn replace_in(path: &Path, from: &str, to: &str) {
    let text = std::fs::read_to_string(path).expect("read");
    assert!(text.contains(from), "{text}");
    std::fs::write(path, text.replace(from, to)).expect("written");
}

#[test]
fn shards_in_any_order_merge_to_the_bytes_of_one_replay() {
    let campaign = Planned::new(&format!(
        "formats = [\"npz\", \"zarr\", \"masks\", \"s7k\"]\n{FIXED}[grid]\n\"scene.seed\" = [1, 2]\n"
    ));
    let manifest = campaign.manifest();
    let (runs, shards) = (&manifest["runs"], &manifest["shards"]);
    assert_eq!(runs.as_array().map(Vec::len), Some(2));
    assert_eq!(shards.as_array().map(Vec::len), Some(6), "7 pings, 3 each");
    assert!(shards[0]["cost_s"].as_f64().is_some_and(|s| s > 0.0));
    assert_eq!(shards[2]["pings"], serde_json::json!([7, 7]));
    // The last first.
    run_well("campaign", campaign.arguments("run", &["--shard", "5"]));
    let told = run("campaign", campaign.arguments("status", &[]));
    assert_eq!(told.code, Some(1));
    assert_eq!(told.out, "1 of 6 shards complete, 0 running, 5 missing\n");
    let missing = run("campaign", campaign.arguments("merge", &[]));
    assert_eq!(missing.code, Some(1));
    assert!(
        missing.err.contains("shard 4: is missing"),
        "{}",
        missing.err
    );
    assert!(!campaign.out().join("merged").exists());
    run_well("campaign", campaign.arguments("run", &["--jobs", "2"]));
    run_well("campaign", campaign.arguments("status", &[]));
    let merged = run_well("campaign", campaign.arguments("merge", &["--check"]));
    for name in [
        "truth.jsonl",
        "pings.npz",
        "pings.zarr",
        "masks.npz",
        "fan_masks.npz",
    ] {
        for run in ["run-0001", "run-0002"] {
            let line = format!("merged/{run}/{name}: equal to one replay");
            assert!(merged.contains(&line), "{line}\n{merged}");
        }
    }
    assert!(
        merged.contains("6 files of other formats remain"),
        "{merged}"
    );
    assert!(!merged.contains("differs"), "{merged}");
}

#[test]
fn shards_with_selected_methods_merge_to_the_bytes_of_one_replay() {
    // Several blocks of the selection, in swell; the shards begin within blocks.
    let campaign = Planned::of(
        "hil-configs/quickstart.toml",
        "pings = [1, 60]\nshard_pings = 25",
        "formats = [\"npz\"]\n[set]\n\"sonar.ping.range_m\" = 60.0\n",
    );
    run_well("campaign", campaign.arguments("run", &["--jobs", "2"]));
    let merged = run_well("campaign", campaign.arguments("merge", &["--check"]));
    assert_eq!(merged.matches("equal to one replay").count(), 2, "{merged}");
}

#[test]
fn a_check_tells_of_shards_that_are_not_the_replay() {
    let campaign = Planned::new(&format!("formats = [\"npz\"]\n{FIXED}"));
    run_well("campaign", campaign.arguments("run", &[]));
    // A shard of other samples whose record was written for them.
    let target = campaign.shard(1);
    let changed = campaign.shard(0);
    std::fs::copy(changed.join("pings.npz"), target.join("pings.npz")).expect("copied");
    let of = |shard: &Path| -> Value {
        let text = std::fs::read_to_string(shard.join("shard.json")).expect("a record");
        serde_json::from_str(&text).expect("JSON")
    };
    let mut record = of(&target);
    record["files"][0] = of(&changed)["files"][0].clone();
    std::fs::write(target.join("shard.json"), record.to_string()).expect("written");
    let told = run("campaign", campaign.arguments("merge", &["--check"]));
    assert_eq!(told.code, Some(1), "{}{}", told.out, told.err);
    assert!(
        told.out
            .contains("pings.npz: differs from one replay at byte"),
        "{}",
        told.out
    );
}

#[test]
fn a_shard_is_computed_once_and_again_only_where_it_is_damaged() {
    let campaign = Planned::new(&format!("formats = [\"npz\"]\n{FIXED}"));
    let shard = || run_well("campaign", campaign.arguments("run", &["--shard", "1"]));
    assert_eq!(shard(), "shard 1: computed\n");
    let file = campaign.shard(1).join("pings.npz");
    let bytes = std::fs::read(&file).expect("read");
    assert_eq!(shard(), "shard 1: complete already\n");
    // A worker that ended leaves its folder; the next one replaces it.
    let beside = campaign.shard(2).with_extension("partial");
    std::fs::create_dir_all(&beside).expect("made");
    std::fs::write(beside.join("left.txt"), "left").expect("written");
    run_well("campaign", campaign.arguments("run", &["--shard", "2"]));
    assert!(!beside.exists() && !campaign.shard(2).join("left.txt").exists());
    let mut damaged = bytes.clone();
    *damaged.last_mut().expect("bytes") ^= 1;
    std::fs::write(&file, damaged).expect("written");
    run_well("campaign", campaign.arguments("run", &["--shard", "0"]));
    let refused = run("campaign", campaign.arguments("merge", &[]));
    assert_eq!(refused.code, Some(1));
    assert!(
        refused
            .err
            .contains("pings.npz: has another checksum than recorded"),
        "{}",
        refused.err
    );
    assert_eq!(shard(), "shard 1: computed\n");
    assert_eq!(
        std::fs::read(&file).expect("read"),
        bytes,
        "the same bits again"
    );
}

#[test]
fn another_version_processor_or_configuration_is_refused() {
    let campaign = Planned::new(&format!("formats = [\"npz\"]\n{FIXED}"));
    run_well("campaign", campaign.arguments("run", &[]));
    let record = campaign.shard(0).join("shard.json");
    let original = std::fs::read_to_string(&record).expect("read");
    replace_in(&record, "\"simd\": \"", "\"simd\": \"other ");
    let mixed = run("campaign", campaign.arguments("merge", &[]));
    assert_eq!(mixed.code, Some(1));
    assert!(
        mixed.err.contains("shard 0: vector instructions other "),
        "{}",
        mixed.err
    );
    std::fs::write(&record, original).expect("written");
    // A changed configuration, and one that is planned again.
    let manifest = campaign.out().join("campaign.json");
    let text = std::fs::read_to_string(&manifest).expect("read");
    let hash = campaign.manifest()["runs"][0]["configuration"].clone();
    let hash = hash.as_str().expect("a hash");
    std::fs::write(&manifest, text.replace(hash, &"0".repeat(64))).expect("written");
    let changed = run("campaign", campaign.arguments("run", &["--shard", "0"]));
    assert_eq!(changed.code, Some(1));
    assert!(
        changed
            .err
            .contains("has changed since the campaign was planned"),
        "{}",
        changed.err
    );
    let again = run("campaign", campaign.plan_arguments());
    assert_eq!(again.code, Some(2));
    assert!(again.err.contains("use another folder"), "{}", again.err);
    std::fs::write(&manifest, text.replace(env!("CARGO_PKG_VERSION"), "0.0.1")).expect("written");
    let older = run("campaign", campaign.arguments("run", &["--shard", "0"]));
    assert!(older.err.contains("planned with 0.0.1"), "{}", older.err);
}

#[test]
fn two_workers_do_not_compute_one_shard() {
    let campaign = Planned::new(&format!("formats = [\"npz\"]\n{FIXED}"));
    std::fs::create_dir_all(campaign.out().join("shards")).expect("made");
    let lock = std::fs::File::create(campaign.shard(0).with_extension("lock")).expect("made");
    lock.lock().expect("locked");
    let busy = run("campaign", campaign.arguments("run", &["--shard", "0"]));
    assert_eq!(busy.code, Some(1));
    assert!(
        busy.err
            .contains("shard 0 is being computed by another worker"),
        "{}",
        busy.err
    );
    let told = run("campaign", campaign.arguments("status", &[]));
    assert_eq!(told.out, "0 of 3 shards complete, 1 running, 2 missing\n");
    drop(lock);
    run_well("campaign", campaign.arguments("run", &["--shard", "0"]));
}

#[test]
fn campaign_files_are_refused_with_the_key_and_the_rule() {
    let folder = tempfile::tempdir().expect("a folder");
    let rig = echotank_testing::repository().join("python/examples/rigs/flat.toml");
    for (text, words) in [
        ("pings = [0, 5]\nformats = [\"npz\"]", "pings = [0, 5]"),
        (
            "pings = [1, 5]\nformats = []",
            "must name at least one of s7k",
        ),
        (
            "pings = [1, 5]\nformats = [\"mp3\"]",
            "\"mp3\": must be one of s7k",
        ),
        (
            "pings = [1, 5]\nformats = [\"npz\"]\nshard_pings = 0",
            "shard_pings = 0: must be at least 1",
        ),
        (
            "pings = [1, 5]\nformats = [\"npz\"]\nshard = 3",
            "unknown field `shard`",
        ),
        (
            "pings = [1, 5]\nformats = [\"npz\"]\n[set]\n\"sonar.ping.range_m\" = -1",
            "run-0001 (sonar.ping.range_m=-1)",
        ),
        (
            "pings = [1, 5]\nformats = [\"npz\"]\n[grid]\n\"scene.seed\" = []",
            "scene.seed has no value",
        ),
        (
            "pings = [1, 4000000000]\nformats = [\"npz\"]",
            "at most 1000000 shards",
        ),
        (
            "pings = [1, 5]\nformats = [\"sas\"]",
            "sas would write nothing",
        ),
    ] {
        let file = folder.path().join("campaign.toml");
        std::fs::write(&file, format!("rig = {rig:?}\n{text}\n")).expect("written");
        let out = folder.path().join("out");
        let told = ended(
            command("campaign")
                .arg("plan")
                .arg(&file)
                .arg("--out")
                .arg(&out),
        );
        assert_eq!(told.code, Some(2), "{text}: {}", told.err);
        assert!(told.err.contains(words), "{text}: {}", told.err);
        assert!(!out.exists());
    }
}

#[test]
fn schedulers_get_a_task_for_each_shard() {
    let campaign = Planned::new(&format!("formats = [\"npz\"]\n{FIXED}"));
    let (slurm, kubernetes) = (
        campaign.folder.path().join("job.sh"),
        campaign.folder.path().join("job.yaml"),
    );
    let mut plan = command("campaign");
    plan.args(campaign.plan_arguments()).args(["--cores", "2"]);
    plan.arg("--slurm")
        .arg(&slurm)
        .arg("--kubernetes")
        .arg(&kubernetes);
    assert_eq!(ended(&mut plan).code, Some(0));
    let script = std::fs::read_to_string(&slurm).expect("written");
    for line in [
        "#SBATCH --array=0-2",
        "#SBATCH --requeue",
        "#SBATCH --cpus-per-task=2",
    ] {
        assert!(script.lines().any(|l| l == line), "{script}");
    }
    // The script computes the shard of its task.
    let done = std::process::Command::new("sh")
        .arg(&slurm)
        .env("SLURM_ARRAY_TASK_ID", "1")
        .output()
        .expect("a shell");
    assert_eq!(String::from_utf8_lossy(&done.stdout), "shard 1: computed\n");
    let job = std::fs::read_to_string(&kubernetes).expect("written");
    for words in [
        "completionMode: Indexed",
        "completions: 3\n",
        "$JOB_COMPLETION_INDEX",
    ] {
        assert!(job.contains(words), "{job}");
    }
}
