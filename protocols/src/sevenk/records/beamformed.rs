//! Record 7018 (beamformed data): magnitude and phase of every sample of every beam. Source: DFD
//! 3.12.
//!
//! ```text
//! RTH   52 bytes, see Rth7018
//! RD    sample-major: per sample, per beam (u16 amplitude, i16 phase); sample 0 is range 0
//! ```

use std::fmt;
use std::ops::Range;

use binrw::{BinRead, BinWrite};

use super::{data_at, rth};
use crate::sevenk::frame::{
    Layout, OpenRecord, RecordStamp, extend_encoded, extend_transposed, read_fixed, u16_at,
    write_layout,
};
use crate::sevenk::{WireError, record_id};

/// Counts of phase per radian.
pub const PHASE_COUNTS_PER_RAD: f32 = 10_430.0;

/// Record type header of record 7018 (beamformed data).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, BinRead, BinWrite)]
pub struct Rth7018 {
    /// Serial number of the sonar.
    pub sonar_id: u64,
    /// Ping number, sequential from 1.
    pub ping_number: u32,
    /// Sequence number in multi-ping mode; 0 in other modes.
    pub multi_ping_sequence: u16,
    /// Number of beams.
    pub beams: u16,
    /// Number of samples of each beam.
    #[brw(pad_after = 32)]
    pub samples: u32,
}

rth!(Rth7018, 52, "7018 beamformed");

/// One sample of one beam.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct BeamSample {
    /// Magnitude in counts.
    pub amplitude: u16,
    /// Phase in counts, [`PHASE_COUNTS_PER_RAD`] per radian.
    pub phase: i16,
}

impl BeamSample {
    const BYTES: usize = 4;

    #[inline]
    pub(super) fn to_le_bytes(self) -> [u8; 4] {
        let ([a0, a1], [p0, p1]) = (self.amplitude.to_le_bytes(), self.phase.to_le_bytes());
        [a0, a1, p0, p1]
    }
}

/// Parsed record 7018 (beamformed data) that borrows its samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Beamformed7018<'a> {
    /// Record type header.
    pub rth: Rth7018,
    data: &'a [u8],
}

impl<'a> Beamformed7018<'a> {
    /// Parses the body of the record. Returns an error if the body is too short.
    pub fn parse(body: &'a [u8]) -> Result<Self, WireError> {
        let rth: Rth7018 = read_fixed(body)?;
        let len = u64::from(rth.beams) * u64::from(rth.samples) * BeamSample::BYTES as u64;
        Ok(Self {
            rth,
            data: data_at(body, Rth7018::RTH_BYTES, len, "7018 samples")?,
        })
    }

    /// Sample of a beam; `None` outside the record.
    pub fn sample(&self, sample: u32, beam: u16) -> Option<BeamSample> {
        if sample >= self.rth.samples || beam >= self.rth.beams {
            return None;
        }
        let at =
            (sample as usize * usize::from(self.rth.beams) + usize::from(beam)) * BeamSample::BYTES;
        Some(BeamSample {
            amplitude: u16_at(self.data, at)?,
            phase: u16_at(self.data, at + 2)? as i16,
        })
    }

    /// All samples in record order: by sample, then by beam.
    pub fn samples(&self) -> impl ExactSizeIterator<Item = BeamSample> + 'a {
        self.data
            .chunks_exact(BeamSample::BYTES)
            .map(|bytes| BeamSample {
                amplitude: u16::from_le_bytes([bytes[0], bytes[1]]),
                phase: i16::from_le_bytes([bytes[2], bytes[3]]),
            })
    }
}

/// Appends a record 7018 (beamformed data). Samples are in order of sample, then beam.
///
/// # Panics
/// If their number is not `rth.samples * rth.beams`.
pub fn emit_7018(
    buf: &mut Vec<u8>,
    stamp: &RecordStamp,
    rth: &Rth7018,
    samples_sample_major: &[BeamSample],
) -> Range<usize> {
    let open = begin_7018(buf, stamp, rth, samples_sample_major.len());
    extend_encoded(buf, samples_sample_major, BeamSample::to_le_bytes);
    open.finish(buf)
}

/// Appends a record 7018 (beamformed data) from samples ordered by beam, then by sample, and transposes them. The first `silent`
/// samples of every beam are zero and absent from the slice.
///
/// # Panics
/// If the number of samples is not `(rth.samples - silent) * rth.beams`.
pub fn emit_7018_beam_major(
    buf: &mut Vec<u8>,
    stamp: &RecordStamp,
    rth: &Rth7018,
    silent: usize,
    samples_beam_major: &[BeamSample],
) -> Range<usize> {
    let beams = usize::from(rth.beams);
    let open = begin_7018(buf, stamp, rth, silent * beams + samples_beam_major.len());
    buf.resize(buf.len() + silent * beams * BeamSample::BYTES, 0);
    extend_transposed(buf, samples_beam_major, beams, BeamSample::to_le_bytes);
    open.finish(buf)
}

fn begin_7018(buf: &mut Vec<u8>, stamp: &RecordStamp, rth: &Rth7018, samples: usize) -> OpenRecord {
    let expected = rth.samples as usize * usize::from(rth.beams);
    assert_eq!(
        samples, expected,
        "7018 of {} samples x {} beams",
        rth.samples, rth.beams
    );
    let open = OpenRecord::begin(buf, record_id::BEAMFORMED, stamp);
    buf.reserve(Rth7018::SIZE_BYTES + expected * BeamSample::BYTES + 4);
    write_layout(rth, buf);
    open
}

impl fmt::Display for Beamformed7018<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "beamformed: ping {} of sonar {}, {} beams x {} samples, amplitude and phase",
            self.rth.ping_number, self.rth.sonar_id, self.rth.beams, self.rth.samples
        )
    }
}
