//! `masks.npz`: labels of each sample of each side-scan line, aligned with `lines` of `pings.npz`.
//!
//! | array | shape | type and content |
//! |---|---|---|
//! | `target` | pings, lines, samples | u2, 1 is the scene's first target, 0 none; the target whose echoes hold more energy than all others |
//! | `shadow` | pings, lines, samples | u1, 1 where the ground on the beam axis exists but is not insonified, and no target is labelled |
//! | `depth_m` | pings, lines, samples | f4, m below the world's origin, of the ground on the beam axis; NaN where absent |
//! | `line_side` | lines | i4, -1 port, +1 starboard |
//! | `ping_number` | pings | i8 |
//!
//! `fan_masks.npz` labels every beam of the first fan (pings, beams, samples), aligned with `beams` of `pings.npz`, without `line_side`.

use std::path::{Path, PathBuf};

use super::npz::{Archive, write_items};
use super::{PartialFile, RecordError};
use echotank_core::ping::{GroundSeen, LineTruth, Side};

/// Labels of the samples of one side-scan line or beam.
#[derive(Clone, Debug, PartialEq)]
pub struct SampleLabels {
    /// Side of the platform.
    pub side: Side,
    /// Target whose echoes hold more energy than all others: 1 is the scene's first target, 0 none.
    pub target: Vec<u16>,
    /// 1 where the ground on the beam axis exists but is not insonified, and no target is labelled.
    pub shadow: Vec<u8>,
    /// Depth of the ground on the beam axis below the world's origin, metres; NaN where absent.
    pub depth_m: Vec<f32>,
}

impl SampleLabels {
    /// Picture pixels use the same rule.
    pub(crate) fn of(truth: &LineTruth) -> Self {
        let energies = truth.target_energy.iter().zip(&truth.other_energy);
        let target: Vec<u16> = (truth.target.iter().zip(energies))
            .map(|(target, (own, others))| if own > others { *target } else { 0 })
            .collect();
        Self {
            side: truth.side,
            shadow: (truth.ground.iter().zip(&target))
                .map(|(ground, target)| u8::from(*ground == GroundSeen::Hidden && *target == 0))
                .collect(),
            depth_m: truth.down_m.clone(),
            target,
        }
    }
}

pub(crate) struct MaskRecorder {
    path: PathBuf,
    target: PartialFile,
    shadow: PartialFile,
    depth_m: PartialFile,
    ping_number: PartialFile,
    /// Side of each line; `None` for beams.
    sides: Option<Vec<Side>>,
    rows: usize,
    samples: usize,
    pings: usize,
    bytes: Vec<u8>,
}

impl MaskRecorder {
    /// Creates `dir/masks.npz`; the folder must exist.
    pub(crate) fn of_lines(dir: &Path) -> Result<Self, RecordError> {
        Self::create(dir, "masks.npz", Some(Vec::new()))
    }

    /// Creates `dir/fan_masks.npz`; the folder must exist.
    pub(crate) fn of_beams(dir: &Path) -> Result<Self, RecordError> {
        Self::create(dir, "fan_masks.npz", None)
    }

    fn create(dir: &Path, name: &str, sides: Option<Vec<Side>>) -> Result<Self, RecordError> {
        let grow = |member: &str| PartialFile::create(&dir.join(format!("{name}.{member}")));
        Ok(Self {
            path: dir.join(name),
            target: grow("target")?,
            shadow: grow("shadow")?,
            depth_m: grow("depth_m")?,
            ping_number: grow("ping_number")?,
            sides,
            rows: 0,
            samples: 0,
            pings: 0,
            bytes: Vec::new(),
        })
    }

    pub(crate) fn push(
        &mut self,
        ping_number: u32,
        truths: &[LineTruth],
    ) -> Result<(), RecordError> {
        if self.pings == 0 {
            if let Some(sides) = &mut self.sides {
                sides.extend(truths.iter().map(|t| t.side));
            }
            self.rows = truths.len();
            self.samples = truths.first().map_or(0, |t| t.target.len());
        }
        let odd = truths.iter().find(|t| t.target.len() != self.samples);
        if let Some(odd) = odd {
            return Err(RecordError::ShapeChanged {
                path: self.path.clone(),
                ping_number,
                what: "line samples",
                got: odd.target.len(),
                want: self.samples,
            });
        }
        let bytes = &mut self.bytes;
        for truth in truths {
            let SampleLabels { target, shadow, .. } = SampleLabels::of(truth);
            write_items(&mut self.target, bytes, &target, |t, out| {
                out.extend(t.to_le_bytes())
            })?;
            self.shadow.write(&shadow)?;
            write_items(&mut self.depth_m, bytes, &truth.down_m, |d, out| {
                out.extend(d.to_le_bytes())
            })?;
        }
        self.ping_number
            .write(&i64::from(ping_number).to_le_bytes())?;
        self.pings += 1;
        Ok(())
    }

    /// Assembles the file and returns its path; `None` without pings.
    pub(crate) fn finish(self) -> Result<Option<PathBuf>, RecordError> {
        if self.pings == 0 {
            return Ok(None);
        }
        let mut archive = Archive::create(&self.path)?;
        let shape = [self.pings, self.rows, self.samples];
        archive.streamed("target", "<u2", &shape, self.target)?;
        archive.streamed("shadow", "|u1", &shape, self.shadow)?;
        archive.streamed("depth_m", "<f4", &shape, self.depth_m)?;
        if let Some(sides) = &self.sides {
            let numbers: Vec<u8> = (sides.iter())
                .flat_map(|side| match side {
                    Side::Port => (-1_i32).to_le_bytes(),
                    Side::Starboard => 1_i32.to_le_bytes(),
                })
                .collect();
            archive.small("line_side", "<i4", &[sides.len()], &numbers)?;
        }
        archive.streamed("ping_number", "<i8", &[self.pings], self.ping_number)?;
        archive.finish()?;
        Ok(Some(self.path))
    }
}
