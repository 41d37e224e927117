//! Records of bottom detections and calibrated samples: 7027, 7028, 7058, 7042, 7057.
//!
//! Levels in the water are volts without sensitivity, gain and time-varying gain. Scattering strength is the echo level, minus
//! source level and footprint, plus twice the transmission loss (20 log r + absorption). The transmit pattern is not removed, and
//! the flags of the record state this.

use std::f64::consts::PI;

use num_complex::Complex32;

use echotank_protocols::sevenk::RecordStamp;
use echotank_protocols::sevenk::records::{
    BeamSample, BeamSamples, Detection7027, PHASE_COUNTS_PER_RAD, Rth7027, Rth7028, Rth7042,
    Rth7058, SnippetDescriptor, SnippetSamples, emit_7027, emit_7028, emit_7042,
    emit_7042_of_16_bits, emit_7058, flags_7042,
};

use super::quantise::{MAGNITUDE_FULL_SCALE, phase_rad};
use super::stored_settings::StoredSettings;
use echotank_config::spec::SonarSpec;
use echotank_core::arrays::TimeVaryingGain;
use echotank_core::ping::{BeamFrame, Detection, PingOutput, PingPlan, Sounding};
use echotank_core::pulse::PulseKind;

/// Brightness and colinearity tests passed. Every detection has passed equivalent tests.
const QUALITY_PASSED: u32 = 0b11;
/// Detection flag: the quality is of type 1.
const QUALITY_TYPE_1: u32 = 1 << 2;
/// Detection algorithm: amplitude or phase, whichever is more accurate.
const ALGORITHM_G2: u8 = 2;
/// Samples added to a snippet on each side of the footprint.
const SNIPPET_MARGIN: f64 = 8.0;
/// Span of the 8-bit values of 7042: 20 log10(65535) dB.
const DB_OF_16_BITS: f64 = 96.329_6;
/// Unsupported flags of the 7042 set-up: compression factor, segments, delay in the first sample.
const NOT_DONE: u32 =
    flags_7042::COMPRESSION_FACTOR | flags_7042::SEGMENTS | flags_7042::FIRST_SAMPLE_IS_DELAY;

/// True if 7042 supports these flags.
pub(crate) fn can_compress(flags: u32) -> bool {
    let both = flags_7042::DB_IN_8_BITS | flags_7042::MAGNITUDE_IN_32_BITS;
    flags & NOT_DONE == 0 && flags & both != both
}

/// Buffers for the records of this module.
#[derive(Default)]
pub(super) struct Workspace {
    detections: Vec<Detection7027>,
    descriptors: Vec<SnippetDescriptor>,
    intensities: Vec<u16>,
    strengths_db: Vec<f32>,
    footprints_m2: Vec<f32>,
    magnitudes: Vec<u32>,
    phases: Vec<i16>,
    lengths: Vec<usize>,
}

/// One ping, and the position of its samples.
pub(super) struct Source<'a> {
    pub plan: &'a PingPlan,
    pub output: &'a PingOutput,
    pub sonar: &'a SonarSpec,
    pub stored: &'a StoredSettings,
    /// Number of samples between the start of the pulse and the first computed sample.
    pub silent: usize,
    pub stamp: RecordStamp,
}

impl Source<'_> {
    fn rate_hz(&self) -> f64 {
        self.sonar.receiver.sample_rate_hz
    }
    fn full_scale_v(&self) -> f64 {
        self.sonar.receiver.full_scale_v
    }
    fn metres_per_sample(&self) -> f64 {
        0.5 * self.plan.sound_speed_m_per_s / self.rate_hz()
    }
    /// Duration of a compressed pulse, seconds.
    fn compressed_s(&self) -> f64 {
        match self.plan.pulse.kind {
            PulseKind::Cw => self.plan.pulse.duration_s,
            PulseKind::LfmUp | PulseKind::LfmDown => 1.0 / self.plan.pulse.bandwidth_hz.max(1.0),
        }
    }
    /// Receiver gain plus array sensitivity at a slant range, dB re 1 V/uPa.
    pub(super) fn gain_db(&self, array: usize, range_m: f64) -> f64 {
        self.sonar.receive[array].sensitivity_db
            + self.plan.settings.gain_db
            + tvg_db(&self.sonar.receiver.tvg, range_m)
    }
}

/// Time-varying gain at a slant range, dB.
fn tvg_db(tvg: &TimeVaryingGain, range_m: f64) -> f64 {
    match tvg {
        TimeVaryingGain::None => 0.0,
        TimeVaryingGain::Law {
            spreading,
            absorption_db_per_m,
            max_db,
        } => (spreading * range_m.max(f64::MIN_POSITIVE).log10()
            + 2.0 * absorption_db_per_m * range_m)
            .clamp(0.0, *max_db),
        TimeVaryingGain::Table(rows) => {
            let after = rows.partition_point(|&(r, _)| r <= range_m);
            match (after.checked_sub(1).map(|k| rows[k]), rows.get(after)) {
                (Some((r0, g0)), Some(&(r1, g1))) => g0 + (g1 - g0) * (range_m - r0) / (r1 - r0),
                (Some((_, g)), None) | (None, Some(&(_, g))) => g,
                (None, None) => 0.0,
            }
        }
    }
}

/// Record 7027 (bottom detections).
pub(super) fn detections(work: &mut Workspace, source: &Source<'_>, buf: &mut Vec<u8>) {
    let (plan, rate_hz) = (source.plan, source.rate_hz());
    let end = (source.silent + plan.sample_count) as f32;
    work.detections.clear();
    let scale = MAGNITUDE_FULL_SCALE / source.full_scale_v();
    work.detections
        .extend(source.output.soundings.iter().map(|s| Detection7027 {
            beam: s.beam as u16,
            detection_sample: (s.twtt_s * rate_hz) as f32,
            rx_angle_rad: s.angle_rad as f32,
            flags: QUALITY_TYPE_1
                | match s.detection {
                    Detection::Amplitude => 1,
                    Detection::Phase => 2,
                },
            quality: QUALITY_PASSED,
            uncertainty: (s.error_s / s.twtt_s) as f32,
            intensity: (s.level_v * scale) as f32,
            min_limit_sample: source.silent as f32,
            max_limit_sample: end,
        }));
    let rth = Rth7027 {
        sonar_id: source.sonar.serial,
        ping_number: plan.ping_number,
        detection_algorithm: ALGORITHM_G2,
        sampling_rate_hz: rate_hz as f32,
        ..Rth7027::default()
    };
    emit_7027(buf, &source.stamp, &rth, &work.detections);
}

/// Half the time for which the beam of a sounding covers a flat seabed, in samples.
fn half_footprint_samples(sounding: &Sounding, fan: &BeamFrame, rate_hz: f64) -> f64 {
    let width_rad = fan.width_rad.get(sounding.beam).copied().unwrap_or(0.0);
    0.5 * width_rad * sounding.angle_rad.abs().min(1.45).tan() * sounding.twtt_s * rate_hz
}

/// Computes the sample ranges of the snippets of a ping, counted from range 0.
fn snippets(work: &mut Workspace, source: &Source<'_>, fan: &BeamFrame) {
    let window = source.stored.snippets;
    let last = (source.silent + fan.samples).saturating_sub(1) as u32;
    work.descriptors.clear();
    for sounding in &source.output.soundings {
        let at = sounding.twtt_s * source.rate_hz();
        let half = half_footprint_samples(sounding, fan, source.rate_hz()) + SNIPPET_MARGIN;
        let mut samples = if window.flags & 1 == 0 {
            f64::from(window.max_samples)
        } else {
            2.0 * half + 1.0
        };
        samples = samples
            .max(f64::from(window.min_samples))
            .min(f64::from(window.max_samples))
            .max(1.0);
        let half = (0.5 * (samples - 1.0)).round() as u32;
        let detection = (at.round().max(0.0) as u32).clamp(source.silent as u32, last);
        work.descriptors.push(SnippetDescriptor {
            beam: sounding.beam as u16,
            start_sample: detection.saturating_sub(half).max(source.silent as u32),
            detection_sample: detection,
            end_sample: detection.saturating_add(half).min(last),
        });
    }
}

/// Samples of a snippet.
fn samples_of<'a>(
    descriptor: &SnippetDescriptor,
    fan: &'a BeamFrame,
    silent: usize,
) -> &'a [Complex32] {
    let beam = fan.beam(descriptor.beam.into());
    let from = (descriptor.start_sample as usize).saturating_sub(silent);
    let to = (descriptor.end_sample as usize + 1).saturating_sub(silent);
    &beam[from.min(beam.len())..to.min(beam.len())]
}

/// Record 7028 (snippets). Returns the number of clipped intensities.
pub(crate) fn snippets_7028(
    work: &mut Workspace,
    source: &Source<'_>,
    fan: &BeamFrame,
    buf: &mut Vec<u8>,
) -> u64 {
    snippets(work, source, fan);
    let scale = MAGNITUDE_FULL_SCALE / source.full_scale_v();
    let mut saturated = 0;
    work.intensities.clear();
    for descriptor in &work.descriptors {
        for v in samples_of(descriptor, fan, source.silent) {
            let counts = (f64::from(v.norm()) * scale).round();
            saturated += u64::from(!(0.0..=MAGNITUDE_FULL_SCALE).contains(&counts));
            work.intensities
                .push(counts.min(MAGNITUDE_FULL_SCALE) as u16);
        }
    }
    let rth = Rth7028 {
        sonar_id: source.sonar.serial,
        ping_number: source.plan.ping_number,
        control_flags: source.stored.snippets.flags as u8,
        ..Rth7028::default()
    };
    let samples = SnippetSamples::U16(&work.intensities);
    emit_7028(buf, &source.stamp, &rth, &work.descriptors, samples);
    saturated
}

/// Record 7058 (calibrated snippets): scattering strengths with their footprints.
pub(crate) fn strengths_7058(
    work: &mut Workspace,
    source: &Source<'_>,
    (fan, array): (&BeamFrame, usize),
    along_track_width_rad: f64,
    buf: &mut Vec<u8>,
) {
    snippets(work, source, fan);
    let plan = source.plan;
    let transmit = &source.sonar.transmit[source.sonar.receive[array].transmit];
    let source_level_db = plan.settings.source_level_db + transmit.level_offset_db;
    let cell_m = 0.5 * plan.sound_speed_m_per_s * source.compressed_s();
    work.strengths_db.clear();
    work.footprints_m2.clear();
    for descriptor in &work.descriptors {
        let beam = usize::from(descriptor.beam);
        let angle_rad = fan.angle_rad[beam].abs();
        let volts = samples_of(descriptor, fan, source.silent);
        for (k, v) in volts.iter().enumerate() {
            let sample = f64::from(descriptor.start_sample) + k as f64;
            let range_m = (sample * source.metres_per_sample()).max(source.metres_per_sample());
            // The across-track extent is that of the pulse or of the beam on the seabed, whichever is shorter.
            let beam_m = range_m * fan.width_rad[beam] / angle_rad.cos().max(1e-3);
            let pulse_m = cell_m / angle_rad.sin().max(1e-6);
            let footprint_m2 = range_m * along_track_width_rad.min(PI) * beam_m.min(pulse_m);
            let level_db = 20.0 * f64::from(v.norm()).max(f64::MIN_POSITIVE).log10()
                - source.gain_db(array, range_m);
            let loss_db = 20.0 * range_m.log10() + plan.absorption_db_per_m * range_m;
            let strength_db =
                level_db - source_level_db + 2.0 * loss_db - 10.0 * footprint_m2.log10();
            work.strengths_db.push(strength_db as f32);
            work.footprints_m2.push(footprint_m2 as f32);
        }
    }
    let rth = Rth7058 {
        sonar_id: source.sonar.serial,
        ping_number: plan.ping_number,
        // Bit 8: one absorption value for all samples.
        control_flags: 1 << 8,
        absorption_db_per_km: (plan.absorption_db_per_m * 1e3) as f32,
        ..Rth7058::default()
    };
    emit_7058(
        buf,
        &source.stamp,
        &rth,
        &work.descriptors,
        &work.strengths_db,
        Some(&work.footprints_m2),
    );
}

/// Record 7042 (compressed water column) with the flags of its set-up. Returns the number of clipped magnitudes.
pub(crate) fn water_column_7042(
    work: &mut Workspace,
    source: &Source<'_>,
    fan: &BeamFrame,
    buf: &mut Vec<u8>,
) -> u64 {
    let flags = source.stored.water_column_flags;
    let divisor = divisor_7042(flags);
    let largest = if flags & flags_7042::MAGNITUDE_IN_32_BITS == 0 {
        MAGNITUDE_FULL_SCALE
    } else {
        f64::from(u32::MAX)
    };
    let scale = largest / source.full_scale_v();
    let mut saturated = 0;
    lengths_7042(work, source, fan);
    work.magnitudes.clear();
    work.phases.clear();
    let mut ends = Vec::with_capacity(fan.beams);
    for beam in 0..fan.beams {
        let row = &fan.beam(beam)[..work.lengths[beam]];
        for window in row.chunks(divisor) {
            let magnitude = window_magnitude(window, (flags >> 8) & 0xF) * scale;
            let middle = window[window.len() / 2];
            saturated += u64::from(!(0.0..largest + 0.5).contains(&magnitude));
            let held = magnitude.clamp(0.0, largest).round();
            work.magnitudes
                .push(if flags & flags_7042::DB_IN_8_BITS == 0 {
                    held as u32
                } else {
                    (20.0 * held.max(1.0).log10() / DB_OF_16_BITS * 255.0).round() as u32
                });
            work.phases
                .push((phase_rad(middle) * PHASE_COUNTS_PER_RAD).round() as i16);
        }
        ends.push(work.magnitudes.len());
    }
    let mut start = 0;
    let beams: Vec<_> = ends
        .iter()
        .enumerate()
        .map(|(beam, &end)| {
            let range = start..end;
            start = end;
            BeamSamples {
                beam: beam as u16,
                segment: 0,
                magnitudes: &work.magnitudes[range.clone()],
                phases: &work.phases[range],
            }
        })
        .collect();
    let rth = rth_7042(source, fan, divisor);
    emit_7042(buf, &source.stamp, &rth, &beams);
    saturated
}

/// True if 7042 with these flags has every sample, with the magnitude and phase of 7018.
pub(super) fn has_all_samples_in_16_bits(flags: u32) -> bool {
    let others = flags_7042::MAGNITUDE_ONLY
        | flags_7042::DB_IN_8_BITS
        | flags_7042::MAGNITUDE_IN_32_BITS
        | NOT_DONE;
    flags & others == 0 && divisor_7042(flags) == 1
}

/// Record 7042 from the samples of 7018, ordered by beam; see [`has_all_samples_in_16_bits`].
pub(super) fn beams_7042(
    work: &mut Workspace,
    source: &Source<'_>,
    fan: &BeamFrame,
    samples_beam_major: &[BeamSample],
    buf: &mut Vec<u8>,
) {
    lengths_7042(work, source, fan);
    let beam = |(beam, &len): (usize, &usize)| &samples_beam_major[beam * fan.samples..][..len];
    let beams = work.lengths.iter().enumerate().map(beam);
    let rth = rth_7042(source, fan, 1);
    emit_7042_of_16_bits(buf, &source.stamp, &rth, beams);
}

/// Number of samples of which 7042 has one.
fn divisor_7042(flags: u32) -> usize {
    ((flags >> flags_7042::DIVISOR_SHIFT) & 0xF).max(1) as usize
}

/// Number of samples of each beam of 7042, at the rate of the receiver: all, or those to the detection.
fn lengths_7042(work: &mut Workspace, source: &Source<'_>, fan: &BeamFrame) {
    work.lengths.clear();
    work.lengths.resize(fan.beams, fan.samples);
    if source.stored.water_column_flags & flags_7042::LIMITED_BY_DETECTION == 0 {
        return;
    }
    // The first sounding of a beam is the last one here.
    for sounding in source.output.soundings.iter().rev() {
        let at = (sounding.twtt_s * source.rate_hz()).ceil() as usize + 1;
        if let Some(len) = work.lengths.get_mut(sounding.beam) {
            *len = at.saturating_sub(source.silent).min(fan.samples);
        }
    }
}

fn rth_7042(source: &Source<'_>, fan: &BeamFrame, divisor: usize) -> Rth7042 {
    Rth7042 {
        sonar_id: source.sonar.serial,
        ping_number: source.plan.ping_number,
        samples: (source.silent + fan.samples) as u32,
        flags: source.stored.water_column_flags,
        first_sample: source.silent as u32,
        sample_rate_hz: (source.rate_hz() / divisor as f64) as f32,
        ..Rth7042::default()
    }
}

/// Magnitude of a window of samples. `kind` 0 selects the middle sample, 1 the largest sample, 2 the mean.
fn window_magnitude(window: &[Complex32], kind: u32) -> f64 {
    let magnitudes = window.iter().map(|v| f64::from(v.norm()));
    match kind {
        1 => magnitudes.fold(0.0, f64::max),
        2 => magnitudes.sum::<f64>() / window.len() as f64,
        _ => window[window.len() / 2].norm().into(),
    }
}
