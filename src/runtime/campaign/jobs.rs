//! Job files for schedulers: a job array of Slurm, an Indexed Job of Kubernetes.
//!
//! The index of a task is the number of its shard. A task that is lost is started again by the scheduler; a shard that is complete ends at once.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use super::Manifest;

/// Longer than the estimate, which is for an idle machine and without opening the rig.
const TIME_FACTOR: f64 = 4.0;
/// Shortest time limit, minutes.
const MIN_MINUTES: f64 = 10.0;
/// Maximum number of tasks of a job array: Slurm refuses indices above 1000 (`MaxArraySize`) unless its administrator allows more.
const MAX_TASKS: usize = 1000;

/// Time limit of a task of the costliest shard, whole minutes.
fn minutes(manifest: &Manifest, cores: usize) -> u64 {
    let cost_s = manifest.shards.iter().map(|shard| shard.cost_s);
    let longest_s = cost_s.fold(0.0, f64::max) / cores.max(1) as f64;
    (TIME_FACTOR * longest_s / 60.0).max(MIN_MINUTES).ceil() as u64
}

/// A word for a shell.
fn quoted(text: &str) -> String {
    format!("'{}'", text.replace('\'', "'\\''"))
}

/// A batch script of Slurm: `sbatch FILE` starts an array of all shards. With more than [`MAX_TASKS`] shards, each task computes every so-many-th, one
/// after another.
pub fn slurm(manifest: &Manifest, folder: &Path, program: &Path, cores: usize) -> String {
    let shards = manifest.shards.len();
    let tasks = shards.clamp(1, MAX_TASKS);
    let (last, last_shard) = (tasks - 1, shards.saturating_sub(1));
    let minutes = minutes(manifest, cores) * shards.div_ceil(tasks) as u64;
    let (program, folder) = (
        quoted(&program.display().to_string()),
        quoted(&folder.display().to_string()),
    );
    let mut text = String::from("#!/bin/sh\n");
    for option in [
        "job-name=echotank".to_owned(),
        format!("array=0-{last}"),
        format!("cpus-per-task={cores}"),
        format!("time={minutes}"),
        "requeue".to_owned(),
        "open-mode=append".to_owned(),
    ] {
        let _ = writeln!(text, "#SBATCH --{option}");
    }
    text += &match shards > tasks {
        false => format!(
            "exec {program} campaign run {folder} --shard \"$SLURM_ARRAY_TASK_ID\" --threads {cores}\n"
        ),
        // A shard that fails leaves the others of its task alone.
        true => format!(
            "status=0\nfor shard in $(seq \"$SLURM_ARRAY_TASK_ID\" {tasks} {last_shard}); do\n\
             \u{20}   {program} campaign run {folder} --shard \"$shard\" --threads {cores} || status=1\n\
             done\nexit $status\n"
        ),
    };
    text
}

/// The deepest folder that holds both paths.
fn common_folder(one: &Path, other: &Path) -> PathBuf {
    let parts = one.components().zip(other.components());
    let same = parts.take_while(|(a, b)| a == b);
    same.map(|(part, _)| part).collect()
}

/// An Indexed Job of Kubernetes (batch/v1). The image must hold the program. The volume of the claim `echotank` is mounted where this computer has
/// the folder that holds both the campaign and its rig.
pub fn kubernetes(manifest: &Manifest, folder: &Path, cores: usize) -> String {
    let shards = manifest.shards.len();
    let seconds = 60 * minutes(manifest, cores);
    let text = |path: &Path| serde_json::Value::from(path.display().to_string());
    let (root, folder) = (text(&common_folder(&manifest.rig, folder)), text(folder));
    let version = &manifest.version;
    format!(
        r#"apiVersion: batch/v1
kind: Job
metadata:
  name: echotank-campaign
spec:
  completionMode: Indexed
  completions: {shards}
  parallelism: {shards}
  backoffLimitPerIndex: 3
  template:
    spec:
      restartPolicy: Never
      activeDeadlineSeconds: {seconds}
      containers:
        - name: echotank
          image: echotank:{version}
          command: ["/bin/sh", "-c"]
          args: ["exec echotank campaign run \"$0\" --shard \"$JOB_COMPLETION_INDEX\" --threads {cores}", {folder}]
          resources:
            requests: {{ cpu: "{cores}" }}
            limits: {{ cpu: "{cores}" }}
          volumeMounts:
            - name: campaign
              mountPath: {root}
      volumes:
        - name: campaign
          persistentVolumeClaim:
            claimName: echotank
"#
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::campaign::Shard;

    #[test]
    fn a_job_array_computes_more_shards_than_it_may_have_tasks() {
        let shard = Shard {
            run: 0,
            pings: (1, 1),
            cost_s: 1.0,
        };
        let manifest = Manifest {
            version: String::new(),
            simd: String::new(),
            rig: PathBuf::new(),
            formats: Vec::new(),
            runs: Vec::new(),
            shards: vec![shard; 2500],
        };
        let script = slurm(&manifest, Path::new("out"), Path::new("/bin/echo"), 1);
        assert!(
            script
                .contains("#SBATCH --array=0-999\n#SBATCH --cpus-per-task=1\n#SBATCH --time=30\n"),
            "{script}"
        );
        for (task, shards) in [
            (0, vec![0, 1000, 2000]),
            (499, vec![499, 1499, 2499]),
            (999, vec![999, 1999]),
        ] {
            let done = std::process::Command::new("sh")
                .args(["-c", &script])
                .env("SLURM_ARRAY_TASK_ID", task.to_string())
                .output()
                .expect("a shell");
            let line = |shard| format!("campaign run out --shard {shard} --threads 1\n");
            let expected: String = shards.into_iter().map(line).collect();
            assert_eq!(String::from_utf8_lossy(&done.stdout), expected);
            assert!(done.status.success());
        }
    }
}
