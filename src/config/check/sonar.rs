//! Checks one `[[sonar]]` table.

use std::f64::consts::{FRAC_PI_2, PI};
use std::net::IpAddr;

use glam::DVec3;

use super::super::spec::*;
use super::arrays::Arrays;
use super::devices;
use super::families;
use super::instrument::ambient_noise_db;
use super::picture::picture;
use super::samples::{self, Source};
use super::trigger;
use super::{Listener, all, index_of, listen, unique_names};
use crate::keys;
use crate::raw::{Entry, Field, Problems};
use echotank_core::arrays::{
    ArrayGeometry, Mounting, Pattern, Receiver, ReceiverFilter, TimeVaryingGain, TransmitArray,
};
use echotank_core::frames::rotation_from_angles;
use echotank_core::model::{DopplerModel, ModelChoice, PathModel, Synthesis};
use echotank_core::ping::Side;
use echotank_core::pulse::{Pulse, PulseKind};
use echotank_core::settings::SonarSettings;

/// Maximum platform speed for which the sample rate must be sufficient, m/s.
pub(crate) const MAX_PLATFORM_SPEED_M_PER_S: f64 = 10.0;
/// Minimum ratio of sample rate to signal bandwidth. The margin at the band edges is for the matched filter and interpolation.
const OVERSAMPLING: f64 = 1.25;
/// Maximum size of the element samples of one ping, bytes. The limit keeps a wrong unit from exhausting the memory.
const MAX_PING_BYTES: f64 = 8.0 * (1u64 << 30) as f64;
const BYTES_PER_COMPLEX_F64: f64 = 16.0;
/// Bytes of one sample of record 7038: 16-bit I and Q.
pub(crate) const BYTES_PER_7038_SAMPLE: f64 = 4.0;
/// Maximum number of pixels of a synthetic aperture image. Every ping visits every pixel.
const MAX_SYNTHETIC_PIXELS: f64 = 4e6;
/// Maximum number of elements in a 7k record: the field has 16 bits.
const MAX_7K_ELEMENTS: usize = 65_535;
/// Minimum starboard component of a boresight that points to a side. A tilt of half a degree is not an error of sign.
const SIDE_MARGIN: f64 = 0.01;
/// Minimum starboard component of the axis of an across-track array of a fan.
const MIN_ACROSS: f64 = 0.5;
/// Minimum forward component of the axis of an along-track array of a fan.
const MIN_ALONG: f64 = 0.5;

/// Maximum range in the limits. Without limits, the set range.
pub(crate) fn longest_range_m(table: &keys::Sonar) -> Option<f64> {
    let limit = table
        .limits
        .as_ref()
        .and_then(|t| t.range_m.get())
        .map(|(_, longest)| longest);
    limit.or_else(|| table.ping.as_ref()?.range_m.get())
}

/// Checks one sonar. `among` has its index among the sonars, and the names of all sonars.
pub(crate) fn sonar<'t>(
    table: &'t keys::Sonar,
    among: (usize, &[Option<&str>]),
    medium: Option<&MediumSpec>,
    listeners: &mut Vec<Listener<'t>>,
    problems: &mut Problems,
) -> Option<SonarSpec> {
    let pulse = table.pulse.and_then(|t| pulse(t, problems));
    let settings = settings(table, problems);
    let limits = limits(table, problems);

    let transmit_tables = table.transmit.all();
    let transmit_names = unique_names(transmit_tables.iter().map(|t| &t.name), problems);
    let transmit: Vec<_> = transmit_tables
        .iter()
        .map(|t| transmit(t, problems))
        .collect();
    let more_pulses: Vec<_> = table
        .more_pulse
        .all()
        .iter()
        .map(|t| more_pulse(t, pulse.as_ref(), &transmit_names, problems))
        .collect();
    let receive_tables = table.receive.all();
    let receive_names = unique_names(receive_tables.iter().map(|t| &t.name), problems);
    let receive: Vec<_> = receive_tables
        .iter()
        .map(|t| receive(t, &transmit_names, problems))
        .collect();

    let receiver = table
        .receiver
        .as_ref()
        .and_then(|t| receiver(t, pulse.as_ref(), medium, problems));
    if let Some(t) = table.receiver.as_ref() {
        refuse_slow_sampling(t, pulse.as_ref(), limits.as_ref(), medium, problems);
        refuse_bands_beyond_sampling(table, t, pulse.as_ref(), &more_pulses, problems);
    }
    let arrays = Arrays {
        names: &receive_names,
        specs: &receive,
    };
    let largest = LargestPing {
        range_m: longest_range_m(table),
        pulse_duration_s: limits.map(|l| l.pulse_duration_s.1),
        sound_speed_m_per_s: medium.map(|m| m.sound_speed_m_per_s),
        sample_rate_hz: receiver.as_ref().map(|r| r.sample_rate_hz),
    };
    refuse_huge_ping(table, &arrays, &largest, problems);
    let filter = receiver.as_ref().map(|r| r.filter);
    let model = table
        .model
        .as_ref()
        .and_then(|t| model(t, filter, problems));
    let synthesis = table.model.and_then(synthesis);
    let sums_pulses = model.is_none_or(|m| {
        let one_by_one = [
            Synthesis::Direct,
            Synthesis::Gridded1d,
            Synthesis::Reference,
        ];
        one_by_one.contains(&m.synthesis)
    });
    if !more_pulses.is_empty() && !sums_pulses {
        let rule = "needs synthesis = \"direct\", \"gridded-1d\" or \"reference\"";
        problems.refuse(&table.more_pulse, rule);
    }
    if model.is_some_and(|m| m.synthesis == Synthesis::Gridded2d) {
        for t in receive_tables.iter().filter(|t| t.elements.to() == Some(1)) {
            let rule =
                "must be at least 2 with synthesis = \"gridded-2d\", which computes whole lines";
            problems.refuse(&t.elements, rule);
        }
    }
    if model.is_some_and(|m| m.synthesis == Synthesis::GriddedLines)
        && receive_tables.iter().all(|t| t.elements.to() == Some(1))
    {
        for t in receive_tables {
            let rule = "must be at least 2 in one array with synthesis = \"gridded-lines\", which computes whole lines";
            problems.refuse(&t.elements, rule);
        }
    }
    let beams = table
        .beams
        .as_ref()
        .and_then(|t| beams(t, &arrays, problems));
    let picture = table.picture.and_then(|t| picture(t, problems));
    let has_lines = table
        .beams
        .as_ref()
        .is_some_and(|t| t.port.given || t.starboard.given);
    let context = OutputContext {
        arrays: &arrays,
        largest: &largest,
        has_lines,
        pulse: pulse.as_ref(),
        more_pulses: more_pulses.len(),
        beams: beams.as_ref(),
    };
    let outputs = table
        .output
        .as_ref()
        .and_then(|t| outputs(t, &context, listeners, problems));
    let trigger = table
        .trigger
        .as_ref()
        .and_then(|t| trigger::trigger(t, among.0, among.1, listeners, problems));
    let trigger_out = table
        .trigger_out
        .as_ref()
        .and_then(|t| trigger::trigger_out(t, problems));

    Some(SonarSpec {
        name: table.name.text()?.to_owned(),
        serial: table.serial.to()?,
        pulse: pulse?,
        more_pulses: all(more_pulses)?,
        transmit: all(transmit).filter(|t| !t.is_empty())?,
        transmit_names: owned(&transmit_names)?,
        receive: all(receive.clone()).filter(|r| !r.is_empty())?,
        receive_names: owned(&receive_names)?,
        receiver: receiver?,
        // Set with the files of the rig.
        instrument: None,
        settings: settings?,
        limits: limits?,
        trigger: trigger?,
        trigger_out: trigger_out?,
        model: model?,
        synthesis: synthesis?,
        beams: beams?,
        picture: picture?,
        outputs: outputs?,
    })
}

fn owned(names: &[Option<&str>]) -> Option<Vec<String>> {
    names.iter().map(|n| n.map(str::to_owned)).collect()
}

// ---------------------------------------------------------------- pulse and settings

fn pulse(table: &keys::Pulse, problems: &mut Problems) -> Option<Pulse> {
    let center_frequency_hz = table.center_frequency_khz.get();
    let bandwidth_hz = table.bandwidth_khz.get();
    if let (Some("lfm"), Some(center_hz), Some(band_hz)) =
        (table.kind.text(), center_frequency_hz, bandwidth_hz)
        && band_hz >= 2.0 * center_hz
    {
        let rule = "must be below twice center_frequency_khz: the sweep stays above 0 Hz";
        problems.refuse(&table.bandwidth_khz, rule);
    }
    let kind = match (table.kind.text()?, table.sweep.text()?) {
        ("cw", _) => PulseKind::Cw,
        (_, "down") => PulseKind::LfmDown,
        _ => PulseKind::LfmUp,
    };
    Some(Pulse {
        kind,
        center_frequency_hz: center_frequency_hz?,
        bandwidth_hz: match kind {
            PulseKind::Cw => 0.0,
            _ => bandwidth_hz?,
        },
        duration_s: table.duration_ms.get()?,
        taper: table.taper.get()?,
    })
}

/// Checks a further pulse. `own` is the sonar's own pulse.
fn more_pulse(
    table: &keys::MorePulse,
    own: Option<&Pulse>,
    transmit_names: &[Option<&str>],
    problems: &mut Problems,
) -> Option<MorePulseSpec> {
    let own = own?;
    let bandwidth_hz = table.bandwidth_khz.if_given()?.unwrap_or(own.bandwidth_hz);
    let center_frequency_hz = table.center_frequency_khz.if_given()?;
    let center_frequency_hz = center_frequency_hz.unwrap_or(own.center_frequency_hz);
    if bandwidth_hz > own.bandwidth_hz {
        let rule =
            "must be at most sonar.pulse.bandwidth_khz, for which the receiver filter is designed";
        problems.refuse(&table.bandwidth_khz, rule);
    }
    let kind = match (own.kind, table.sweep.text()?) {
        (PulseKind::Cw, _) => PulseKind::Cw,
        (_, "up") => PulseKind::LfmUp,
        _ => PulseKind::LfmDown,
    };
    let apart_hz = (center_frequency_hz - own.center_frequency_hz).abs();
    if kind == own.kind && apart_hz < own.bandwidth_hz {
        let rule = "must be the opposite sweep, or center_frequency_khz at least one bandwidth away: otherwise the pulses cannot be separated";
        problems.refuse(&table.sweep, rule);
    }
    let transmit = table.transmit.given_and_then(|name| {
        let entry = &table.transmit;
        index_of(name, entry, transmit_names, "transmit array", problems)
    })?;
    Some(MorePulseSpec {
        pulse: Pulse {
            kind,
            center_frequency_hz,
            bandwidth_hz,
            ..*own
        },
        delay_s: table.delay_ms.get()?,
        transmit,
    })
}

/// Ping rate, hertz, from the key for the rate or for the period.
fn ping_rate_hz(ping: &keys::Ping) -> Option<f64> {
    match ping.rate_hz.given {
        true => ping.rate_hz.get(),
        false => ping.period_ms.get().map(|s| 1.0 / s),
    }
}

fn settings(sonar: &keys::Sonar, problems: &mut Problems) -> Option<SonarSettings> {
    let ping = sonar.ping.as_ref()?;
    match (ping.rate_hz.given, ping.period_ms.given) {
        (true, true) => problems.refuse(&ping.period_ms, "must not be given together with rate_hz"),
        (false, false) => {
            problems.refuse(&ping.rate_hz, "missing: give either rate_hz or period_ms")
        }
        _ => {}
    }
    Some(SonarSettings {
        pinging: true,
        range_m: ping.range_m.get()?,
        max_ping_rate_hz: ping_rate_hz(ping)?,
        source_level_db: ping.source_level_db.get()?,
        gain_db: ping.gain_db.get()?,
        pulse_duration_s: sonar.pulse.as_ref()?.duration_ms.get()?,
    })
}

/// Limits of the settings. A setting without limits has its own value as both limits. Settings outside their limits are refused.
fn limits(sonar: &keys::Sonar, problems: &mut Problems) -> Option<LimitsSpec> {
    let table = sonar.limits.as_ref()?;
    let ping = sonar.ping.as_ref();
    let pulse = sonar.pulse.as_ref();
    let mut limit = |key: &Field<(f64, f64)>, setting_key: Option<&Entry>, setting: Option<f64>| {
        let given = key.get();
        if let Some((low, high)) = given {
            if low > high {
                problems.refuse(key, "must have the lowest first");
            } else if let (Some(setting_key), Some(setting)) = (setting_key, setting)
                && !(low..=high).contains(&setting)
            {
                let rule = format!("must lie within limits.{} = {}", key.key(), key.text);
                problems.refuse(setting_key, rule);
            }
        }
        match key.given {
            true => given,
            false => setting.map(|s| (s, s)),
        }
    };
    let mut of_ping = |key, setting: fn(&keys::Ping) -> &Field<f64>| {
        let setting = ping.map(setting);
        limit(key, setting.map(|s| &**s), setting.and_then(Field::get))
    };
    let range_m = of_ping(&table.range_m, |p| &p.range_m);
    let source_level_db = of_ping(&table.source_level_db, |p| &p.source_level_db);
    let gain_db = of_ping(&table.gain_db, |p| &p.gain_db);
    let rate: Option<&Entry> = ping.map(|p| match p.rate_hz.given {
        true => &*p.rate_hz,
        false => &*p.period_ms,
    });
    let ping_rate_hz = limit(&table.ping_rate_hz, rate, ping.and_then(ping_rate_hz));
    let duration = pulse.map(|p| &p.duration_ms);
    let pulse_duration_s = limit(
        &table.pulse_duration_ms,
        duration.map(|d| &**d),
        duration.and_then(Field::get),
    );
    Some(LimitsSpec {
        range_m: range_m?,
        ping_rate_hz: ping_rate_hz?,
        source_level_db: source_level_db?,
        gain_db: gain_db?,
        pulse_duration_s: pulse_duration_s?,
    })
}

// ---------------------------------------------------------------- arrays

fn mounting(position_m: &Field<DVec3>, [roll, pitch, yaw]: [&Field<f64>; 3]) -> Option<Mounting> {
    Some(Mounting {
        position_m: position_m.get()?,
        body_from_array: rotation_from_angles(roll.get()?, pitch.get()?, yaw.get()?),
    })
}

/// The pattern called `name`. Its sides are parallel to the x and y axes of the array. `spacing_m`: of the elements of a line.
fn pattern(
    name: &Field<String>,
    [length, width]: [&Field<f64>; 2],
    spacing_m: Option<f64>,
    baffled: Option<bool>,
    problems: &mut Problems,
) -> Option<Pattern> {
    let (mut length_m, width_m) = (length.get()?, width.get()?);
    let has_sides = length_m > 0.0 || width_m > 0.0;
    match name.text()? {
        AUTO if !has_sides => length_m = spacing_m.unwrap_or(0.0),
        AUTO | "rectangle" => {}
        _ => return Some(Pattern::Omnidirectional),
    }
    if length_m == 0.0 && width_m == 0.0 {
        if name.is(AUTO)? {
            return Some(Pattern::Omnidirectional);
        }
        let rule = format!("must have {} or {} above 0", length.key(), width.key());
        problems.refuse(name, rule);
    }
    Some(Pattern::Rectangle {
        length_m,
        width_m,
        baffled: baffled?,
    })
}

fn transmit(table: &keys::Transmit, problems: &mut Problems) -> Option<TransmitArray> {
    let sides = [&table.length_m, &table.width_m];
    let pattern = pattern(&table.pattern, sides, None, table.baffled.get(), problems);
    let angles = [&table.roll_deg, &table.pitch_deg, &table.yaw_deg];
    Some(TransmitArray {
        mounting: mounting(&table.position_m, angles)?,
        pattern: pattern?,
        level_offset_db: table.level_offset_db.get()?,
    })
}

fn receive(
    table: &keys::Receive,
    transmit_names: &[Option<&str>],
    problems: &mut Problems,
) -> Option<ArrayGeometry> {
    let elements = table.elements.to();
    let several = elements.map(|e| e > 1);
    problems.needed_with(&table.spacing_m, several, "more than one element");
    let spacing_m = match table.spacing_m.given {
        true => table.spacing_m.get(),
        false => Some(0.0),
    };
    let sides = [&table.element_length_m, &table.element_width_m];
    let of_line_m = spacing_m.filter(|_| several == Some(true));
    // An arc has none, whatever the default is.
    let baffled = table
        .baffled
        .get()
        .map(|baffled| baffled && !table.radius_m.given);
    let element_pattern = pattern(&table.element_pattern, sides, of_line_m, baffled, problems);
    let angles = [&table.roll_deg, &table.pitch_deg, &table.yaw_deg];
    if let (Some(true), Some(spacing_m), Some(Pattern::Rectangle { length_m, .. })) =
        (several, spacing_m, element_pattern)
        && length_m > spacing_m
        && spacing_m > 0.0
    {
        let rule = format!("must be at most spacing_m = {spacing_m}: elements do not overlap");
        problems.refuse(&table.element_length_m, rule);
    }
    let transmit = match table.transmit.given {
        true => table.transmit.text().and_then(|name| {
            let entry = &table.transmit;
            index_of(name, entry, transmit_names, "transmit array", problems)
        }),
        false if transmit_names.len() <= 1 => Some(0),
        false => {
            let rule = "missing: needed where there are several transmit arrays";
            problems.refuse(&table.transmit, rule);
            None
        }
    };
    let radius_m = match table.radius_m.given {
        true => Some(table.radius_m.get()?),
        false => None,
    };
    let array = ArrayGeometry {
        mounting: mounting(&table.position_m, angles)?,
        elements: elements?,
        spacing_m: spacing_m?,
        radius_m,
        element_pattern: element_pattern?,
        sensitivity_db: table.sensitivity_db.get()?,
        transmit: transmit?,
    };
    if radius_m.is_some() {
        arc(table, &array, problems);
    }
    Some(array)
}

/// What holds for an arc.
fn arc(table: &keys::Receive, array: &ArrayGeometry, problems: &mut Problems) {
    if array.elements < 2 {
        problems.refuse(&table.radius_m, "needs more than one element");
    }
    if array.half_arc_rad() > FRAC_PI_2 {
        let along_m = 2.0 * array.along_m(array.elements - 1);
        let least_m = along_m / PI;
        let rule = format!(
            "must be at least {least_m:.6}: {along_m:.6} m of elements lie on half a circle at most"
        );
        problems.refuse(&table.radius_m, rule);
    }
    if table.baffled.given && table.baffled.get() == Some(true) {
        problems.refuse(&table.baffled, "must be false on an arc (radius_m)");
    }
}

// ---------------------------------------------------------------- receiver

fn receiver(
    table: &keys::Receiver,
    pulse: Option<&Pulse>,
    medium: Option<&MediumSpec>,
    problems: &mut Problems,
) -> Option<Receiver> {
    let law = table.tvg.text();
    let is_law = match (law, table.tvg.other()) {
        (Some(law), _) => Some(law != "none"),
        (None, rows) => rows.map(|_| false),
    };
    problems.only_with(&[&table.tvg_max_db], is_law, "a tvg law");
    let tvg = match (law, table.tvg.other()) {
        (Some("none"), _) => Some(TimeVaryingGain::None),
        (Some(law), _) => table.tvg_max_db.get().map(|max_db| {
            let spreading = match law {
                "20logr" => 20.0,
                "30logr" => 30.0,
                _ => 40.0,
            };
            TimeVaryingGain::Law {
                spreading,
                absorption_db_per_m: known_absorption_db_per_m(medium),
                max_db,
            }
        }),
        (None, Some(rows)) => {
            let increasing = rows.windows(2).all(|w| w[0].0 < w[1].0);
            if !increasing || rows[0].0 < 0.0 {
                let rule = "must have ranges of 0 or more, in ascending order";
                problems.refuse(&table.tvg, rule);
            }
            Some(TimeVaryingGain::Table(rows.to_vec()))
        }
        (None, None) => None,
    };
    Some(Receiver {
        sample_rate_hz: table.sample_rate_khz.get()?,
        filter: match table.rx_filter.text()? {
            "fir" => ReceiverFilter::Fir,
            _ => ReceiverFilter::None,
        },
        tvg: tvg?,
        noise_db: match (table.noise_db.text(), table.noise_db.other()) {
            (Some("none"), _) => None,
            (Some(_), _) => Some(ambient_noise_db(
                pulse?.center_frequency_hz,
                medium?.wind_m_per_s,
            )),
            (None, given) => Some(*given?),
        },
        adc_bits: table.adc_bits.given_and_then(|&n| n.try_into().ok())?,
        full_scale_v: table.full_scale_v.get()?,
        seed: table.seed.to()?,
    })
}

/// Absorption given in the configuration, dB per metre; 0 for a formula. The rig later inserts the value of a formula.
fn known_absorption_db_per_m(medium: Option<&MediumSpec>) -> f64 {
    match medium.map(|m| m.absorption) {
        Some(AbsorptionSpec::Fixed { db_per_m }) => db_per_m,
        _ => 0.0,
    }
}

/// Minimum sample rate, 1.25 (max(B, 4/T) + 2 f_d), for the shortest pulse and the highest frequency of the sweep.
pub(crate) fn min_sample_rate_hz(pulse: &Pulse, shortest_s: f64, sound_speed_m_per_s: f64) -> f64 {
    OVERSAMPLING
        * (pulse.bandwidth_hz.max(4.0 / shortest_s)
            + 2.0 * max_doppler_hz(pulse, sound_speed_m_per_s))
}

/// Doppler shift of an echo from straight ahead at the maximum platform speed.
pub(crate) fn max_doppler_hz(pulse: &Pulse, sound_speed_m_per_s: f64) -> f64 {
    let highest_hz = pulse.center_frequency_hz + pulse.bandwidth_hz / 2.0;
    2.0 * MAX_PLATFORM_SPEED_M_PER_S / sound_speed_m_per_s * highest_hz
}

fn refuse_slow_sampling(
    table: &keys::Receiver,
    pulse: Option<&Pulse>,
    limits: Option<&LimitsSpec>,
    medium: Option<&MediumSpec>,
    problems: &mut Problems,
) {
    let (Some(rate_hz), Some(pulse), Some(limits), Some(medium)) =
        (table.sample_rate_khz.get(), pulse, limits, medium)
    else {
        return;
    };
    let shortest_s = limits.pulse_duration_s.0;
    let c = medium.sound_speed_m_per_s;
    let min_hz = min_sample_rate_hz(pulse, shortest_s, c);
    if rate_hz < min_hz {
        // The rate is rounded up, so the number in the message is sufficient.
        let min_khz = (min_hz / 10.0).ceil() / 100.0;
        let rule = format!(
            "must be at least {min_khz}: 1.25 (max(B, 4/T) + 2 f_d) with B = {} kHz, T = {} ms (the shortest allowed) and f_d = {:.2} kHz at {MAX_PLATFORM_SPEED_M_PER_S} m/s",
            pulse.bandwidth_hz / 1e3,
            shortest_s * 1e3,
            max_doppler_hz(pulse, c) / 1e3,
        );
        problems.refuse(&table.sample_rate_khz, rule);
    }
}

/// Refuses further pulses with a band outside the sampled band.
fn refuse_bands_beyond_sampling(
    sonar: &keys::Sonar,
    receiver: &keys::Receiver,
    own: Option<&Pulse>,
    more: &[Option<MorePulseSpec>],
    problems: &mut Problems,
) {
    let (Some(rate_hz), Some(own)) = (receiver.sample_rate_khz.get(), own) else {
        return;
    };
    let reach_hz = |m: &MorePulseSpec| {
        let apart_hz = (m.pulse.center_frequency_hz - own.center_frequency_hz).abs();
        2.0 * apart_hz + m.pulse.bandwidth_hz
    };
    let min_hz = OVERSAMPLING * more.iter().flatten().map(reach_hz).fold(0.0, f64::max);
    if rate_hz < min_hz {
        let rule = format!(
            "needs receiver.sample_rate_khz of at least {}: all pulses are sampled about the first one's centre",
            (min_hz / 10.0).ceil() / 100.0
        );
        problems.refuse(&sonar.more_pulse, rule);
    }
}

/// Quantities that limit the number of samples of a ping.
struct LargestPing {
    range_m: Option<f64>,
    pulse_duration_s: Option<f64>,
    sound_speed_m_per_s: Option<f64>,
    sample_rate_hz: Option<f64>,
}

impl LargestPing {
    /// Number of samples of one element: two-way travel time to the longest range plus the longest pulse.
    fn samples(&self) -> Option<f64> {
        let window_s = 2.0 * self.range_m? / self.sound_speed_m_per_s? + self.pulse_duration_s?;
        Some((window_s * self.sample_rate_hz?).ceil())
    }
}

fn refuse_huge_ping(
    table: &keys::Sonar,
    arrays: &Arrays<'_>,
    largest: &LargestPing,
    problems: &mut Problems,
) {
    let Some(samples) = largest.samples() else {
        return;
    };
    let elements: usize = arrays.specs.iter().flatten().map(|a| a.elements).sum();
    let bytes = elements as f64 * samples * BYTES_PER_COMPLEX_F64;
    if bytes > MAX_PING_BYTES {
        let rule = format!(
            "{elements} elements of {samples} samples are {:.1} GiB in one ping; at most {} GiB",
            bytes / (1u64 << 30) as f64,
            MAX_PING_BYTES / (1u64 << 30) as f64,
        );
        problems.refuse(&table.receive, rule);
    }
}

// ---------------------------------------------------------------- model, beams, outputs

fn model(
    table: &keys::Model,
    filter: Option<ReceiverFilter>,
    problems: &mut Problems,
) -> Option<ModelChoice> {
    let doppler = match table.doppler.text() {
        Some(AUTO) => Some(start_doppler(table)),
        named => DopplerModel::ALL
            .into_iter()
            .find(|d| Some(d.name()) == named),
    };
    let synthesis = match table.synthesis.text() {
        Some(AUTO) => doppler.zip(filter).map(|(d, f)| start_synthesis(d, f)),
        named => named.and_then(synthesis_named),
    };
    if let (Some(doppler), Some(synthesis)) = (doppler, synthesis)
        && !synthesis.takes(doppler)
    {
        let known = DopplerModel::ALL
            .into_iter()
            .filter(|&d| synthesis.takes(d))
            .map(|d| format!("\"{}\"", d.name()))
            .collect::<Vec<_>>()
            .join(" or ");
        let why = match synthesis {
            gridded if gridded.keeps_tolerance() => "which computes every echo at its exact delay",
            _ => "which uses the same pulse for every echo",
        };
        let name = synthesis.name();
        let rule = format!("must be {known} with synthesis = \"{name}\", {why}");
        problems.refuse(&table.doppler, rule);
    }
    let lines = synthesis.filter(|synthesis| synthesis.makes_lines());
    if lines.is_some() && filter == Some(ReceiverFilter::None) {
        let rule = "needs receiver.rx_filter = \"fir\", which limits the band";
        problems.refuse(&table.synthesis, rule);
    }
    let path = match table.path.text()? {
        // K-segment paths have no steps, so every synthesis method accepts them.
        AUTO => PathModel::KSegment.name(),
        named => named,
    };
    if let (Some(lines), "polyline") = (lines, path) {
        let rule = format!(
            "must be another with synthesis = \"{}\": the attitude steps of \"polyline\" break up an array line; \"k-segment\" has none",
            lines.name()
        );
        problems.refuse(&table.path, rule);
    }
    Some(ModelChoice {
        path: PathModel::ALL.into_iter().find(|p| p.name() == path)?,
        doppler: doppler?,
        synthesis: synthesis?,
        segment_s: match auto_model(table).segment {
            true => START_SEGMENT_S,
            false => table.segment_ms.if_given()?.unwrap_or(SEGMENT_S),
        },
        cull_db: table.cull_db.if_given()?,
    })
}

/// Value of a key whose method is selected automatically.
const AUTO: &str = "auto";

/// Segment length of a named path, seconds.
const SEGMENT_S: f64 = 0.05;

/// Segment length of an automatic path before the method selection, seconds. The length suits any motion.
const START_SEGMENT_S: f64 = 0.001;

fn auto_model(table: &keys::Model) -> AutoModel {
    // The reference uses neither path nor doppler.
    let is_reference = table.synthesis.is(Synthesis::Reference.name()) == Some(true);
    let is_auto = |key: &Field<String>| key.is(AUTO) == Some(true) && !is_reference;
    AutoModel {
        path: is_auto(&table.path),
        segment: is_auto(&table.path) && !table.segment_ms.given,
        doppler: is_auto(&table.doppler),
        synthesis: is_auto(&table.synthesis),
    }
}

/// Doppler model before an automatic selection: the most accurate model that the synthesis accepts.
fn start_doppler(table: &keys::Model) -> DopplerModel {
    let named = table.synthesis.text().and_then(synthesis_named);
    match named.is_some_and(Synthesis::shares_pulse) {
        true => DopplerModel::None,
        false => DopplerModel::StretchQuadratic,
    }
}

fn synthesis_named(name: &str) -> Option<Synthesis> {
    Synthesis::ALL.into_iter().find(|s| s.name() == name)
}

/// Synthesis before an automatic selection: the gridded engine if it certainly meets its tolerance. Without the receiver filter, this depends on the
/// spectrum of the pulse, and the direct sum is used.
fn start_synthesis(doppler: DopplerModel, filter: ReceiverFilter) -> Synthesis {
    match filter {
        ReceiverFilter::Fir if Synthesis::Gridded1d.takes(doppler) => Synthesis::Gridded1d,
        _ => Synthesis::Direct,
    }
}

fn synthesis(table: &keys::Model) -> Option<SynthesisSpec> {
    Some(SynthesisSpec {
        tolerance: table.tolerance.get()?,
        error_check: match table.error_check.given {
            true => table.error_check.get()?,
            false => !table.synthesis.is(Synthesis::Reference.name())?,
        },
        frequency_step_hz: table.frequency_step_hz.if_given()?,
        nearest_m: match table.nearest_m.given {
            true => table.nearest_m.get()?,
            false => SynthesisSpec::default().nearest_m,
        },
        engine_tolerance: None,
        auto: auto_model(table),
        culls_by_window: false,
        image_cells: table.tolerance_image.if_given()?,
        output: table.output.named()?,
        elements_for: None,
    })
}

fn beams(table: &keys::Beams, arrays: &Arrays<'_>, problems: &mut Problems) -> Option<BeamsSpec> {
    let mut lines = Vec::new();
    for (key, side, sign) in [
        (&table.port, Side::Port, -1.0),
        (&table.starboard, Side::Starboard, 1.0),
    ] {
        if !key.given {
            continue;
        }
        let array = arrays.named(key, problems);
        let spec = array.and_then(|a| arrays.specs.get(a)?.as_ref());
        if spec.is_some_and(|s| s.radius_m.is_some()) {
            problems.refuse(key, "must be a straight line: an array without radius_m");
        }
        let looks_across = array
            .and_then(|a| arrays.body_from_array(a))
            .map(|r| sign * (r * DVec3::Z).y);
        if looks_across.is_some_and(|y| y < -SIDE_MARGIN) {
            let rule = "that array looks to the other side (roll_deg is positive to port)";
            problems.refuse(key, rule);
        }
        lines.push(array.map(|array| LineSpec { side, array }));
    }
    let fan = table.fan.given_and_then(|t| fan(t, arrays, problems));
    let synthetic_aperture =
        (table.synthetic_aperture).given_and_then(|t| synthetic_aperture(t, arrays, problems));
    Some(BeamsSpec {
        lines: all(lines)?,
        focused_lines: table.line_former.is("dynamic-focus")?,
        line_f_number: table.line_f_number.if_given()?,
        line_shading: shading(&table.line_shading, table.line_side_lobe_db.get()?, 0.0)?,
        weighting: shading(
            &table.weighting,
            table.weighting_side_lobe_db.get()?,
            table.weighting_beta.get()?,
        )?,
        synthetic_aperture: synthetic_aperture?,
        fan: fan?,
    })
}

fn synthetic_aperture(
    table: &keys::SyntheticAperture,
    arrays: &Arrays<'_>,
    problems: &mut Problems,
) -> Option<SyntheticApertureSpec> {
    let entry = &table.arrays;
    let mut chosen = Vec::new();
    for name in table.arrays.as_ref()? {
        let array = index_of(name, entry, arrays.names, "receive array", problems);
        if array.is_some() && chosen.contains(&array) {
            problems.refuse(entry, format!("contains \"{name}\" twice"));
        }
        chosen.push(array);
    }
    for key in [&table.north_m, &table.east_m] {
        if key.get().is_some_and(|(from, to)| from >= to) {
            problems.refuse(key, "must have the lower edge first");
        }
    }
    let spec = SyntheticApertureSpec {
        arrays: all(chosen)?,
        north_m: table.north_m.get()?,
        east_m: table.east_m.get()?,
        down_m: table.down_m.get()?,
        cell_m: table.cell_m.get()?,
    };
    let (columns, rows) = spec.size();
    if columns as f64 * rows as f64 > MAX_SYNTHETIC_PIXELS {
        let rule = format!("{columns} x {rows} pixels; at most {MAX_SYNTHETIC_PIXELS}");
        problems.refuse(&table.cell_m, rule);
        return None;
    }
    Some(spec)
}

fn fan(table: &keys::Fan, arrays: &Arrays<'_>, problems: &mut Problems) -> Option<FanSpec> {
    let array = arrays.named(&table.array, problems);
    let spec = array.and_then(|a| arrays.specs.get(a)?.as_ref());
    if spec.is_some_and(|s| s.elements < 2) {
        problems.refuse(&table.array, "must be an array of at least two elements");
    }
    let is_arc = spec.is_some_and(|s| s.radius_m.is_some());
    if is_arc && (table.former.is("exact") == Some(true) || table.former.is("fft") == Some(true)) {
        let rule = "must be \"conventional\", \"phase\" or \"dynamic-focus\" for an arc (radius_m)";
        problems.refuse(&table.former, rule);
    }
    if is_arc && table.f_number.given {
        problems.refuse(
            &table.f_number,
            "must be left out for an arc (radius_m): its beams have aperture_deg",
        );
    }
    if spec.is_some() && !is_arc && table.aperture_deg.given {
        problems.refuse(
            &table.aperture_deg,
            "needs an arc: a receive array with radius_m",
        );
    }
    let line = spec.map(|s| s.mounting.body_from_array * DVec3::X);
    if line.is_some_and(|x| x.y < MIN_ACROSS && x.x < MIN_ALONG) {
        let rule = "must be an array across the track whose +x end points to starboard (yaw_deg = 90), or one that lies fore and aft (yaw_deg = 0)";
        problems.refuse(&table.array, rule);
    }
    let center_rad = table.center_deg.get();
    if let (Some(center), Some(sector)) = (center_rad, table.sector_deg.get())
        && center.abs() + 0.5 * sector > FRAC_PI_2 + 1e-9
    {
        let rule = "must keep the sector within 90 degrees of the boresight";
        problems.refuse(&table.center_deg, rule);
    }
    let roll_stabilised = table.roll_stabilised.get()?;
    if roll_stabilised && line.is_some_and(|x| x.y < MIN_ACROSS) {
        problems.refuse(&table.roll_stabilised, "needs an array across the track");
    }
    Some(FanSpec {
        array: array?,
        beams: table.beams.to()?,
        sector_rad: table.sector_deg.get()?,
        shading: shading(&table.shading, table.shading_side_lobe_db.get()?, 0.0)?,
        form: FanForm {
            former: table.former.named()?,
            spacing: table.spacing.named()?,
            center_rad: center_rad?,
            roll_stabilised,
            f_number: table.f_number.if_given()?,
            focus_error_rad: table.focus_error_deg.get()?,
            focus_from_m: table.focus_from_m.get()?,
            aperture_rad: table.aperture_deg.get()?,
            bottom_detection: table.bottom_detection.get()?,
        },
    })
}

fn shading(key: &Field<String>, side_lobe_db: f64, beta: f64) -> Option<Shading> {
    Some(match key.text()? {
        "hann" => Shading::Hann,
        "hamming" => Shading::Hamming,
        "taylor" => Shading::Taylor { side_lobe_db },
        "chebyshev" => Shading::Chebyshev { side_lobe_db },
        "kaiser" => Shading::Kaiser { beta },
        _ => Shading::Uniform,
    })
}

/// Properties of the sonar that outputs depend on.
struct OutputContext<'a, 'b> {
    arrays: &'a Arrays<'b>,
    largest: &'a LargestPing,
    has_lines: bool,
    pulse: Option<&'a Pulse>,
    more_pulses: usize,
    beams: Option<&'a BeamsSpec>,
}

fn outputs<'t>(
    table: &'t keys::Output,
    context: &OutputContext<'_, '_>,
    listeners: &mut Vec<Listener<'t>>,
    problems: &mut Problems,
) -> Option<Vec<OutputSpec>> {
    let &OutputContext {
        arrays,
        largest,
        has_lines,
        pulse,
        more_pulses,
        beams,
    } = context;
    let sonar = families::Sonar {
        arrays,
        samples: largest.samples(),
        has_lines,
        more_pulses,
    };
    let source = Source { arrays, pulse };
    // Of two outputs with the same port, the later one is refused.
    let outputs = [
        output(&table.sevenk, OutputSpec::SevenK, |t| {
            sevenk(t, arrays, largest, listeners, problems)
        }),
        output(&table.jsf, OutputSpec::Jsf, |t| {
            families::jsf(t, &sonar, listeners, problems)
        }),
        output(&table.xtf, OutputSpec::Xtf, |t| {
            families::xtf(t, &sonar, problems)
        }),
        output(&table.imagenex872, OutputSpec::Imagenex872, |t| {
            families::imagenex872(t, &sonar, listeners, problems)
        }),
        output(&table.ping, OutputSpec::Ping, |t| {
            devices::ping(t, beams, listeners, problems)
        }),
        output(&table.wbms, OutputSpec::Wbms, |t| {
            devices::wbms(t, listeners, problems)
        }),
        output(&table.vita49, OutputSpec::Vita49, |t| {
            samples::vita49(t, source, problems)
        }),
        output(&table.elements, OutputSpec::Elements, |t| {
            samples::elements(t, source, listeners, problems)
        }),
        output(&table.sigmf, OutputSpec::Sigmf, |t| {
            samples::sigmf(t, source, problems)
        }),
        output(&table.mcap, OutputSpec::Mcap, samples::mcap),
        output(&table.wav, OutputSpec::Wav, |t| {
            samples::wav(t, source, problems)
        }),
    ];
    let outputs = all(outputs.into())?;
    Some(outputs.into_iter().flatten().collect())
}

/// Checks an optional output table. `Some(None)` if the table is absent.
fn output<'t, T, S>(
    key: &'t Field<T>,
    make: fn(S) -> OutputSpec,
    read: impl FnOnce(&'t T) -> Option<S>,
) -> Option<Option<OutputSpec>> {
    key.given_and_then(|table| read(table).map(make))
}

/// Addresses of hosts in a comma-separated list.
fn third_parties(key: &Field<String>, problems: &mut Problems) -> Option<Vec<IpAddr>> {
    let Some(text) = key.text().filter(|text| !text.trim().is_empty()) else {
        return Some(Vec::new());
    };
    let parsed: Result<Vec<IpAddr>, _> = text.split(',').map(|ip| ip.trim().parse()).collect();
    match parsed {
        Ok(addresses) => Some(addresses),
        Err(_) => {
            problems.refuse(
                key,
                "must be IP addresses without ports, separated by commas",
            );
            None
        }
    }
}

fn sevenk<'t>(
    table: &'t keys::Sevenk,
    arrays: &Arrays<'_>,
    largest: &LargestPing,
    listeners: &mut Vec<Listener<'t>>,
    problems: &mut Problems,
) -> Option<SevenKSpec> {
    let listen = listen(&table.listen, "TCP", listeners, problems);
    let client_queue_bytes = table.client_queue_mib.to::<usize>();
    let chosen = arrays.chosen(&table.arrays, problems);
    if let (Some(chosen), Some(samples)) = (&chosen, largest.samples()) {
        let elements: usize = chosen
            .iter()
            .filter_map(|&a| arrays.specs.get(a)?.as_ref())
            .map(|a| a.elements)
            .sum();
        if elements > MAX_7K_ELEMENTS {
            let rule = format!("{elements} elements; a 7k record holds at most {MAX_7K_ELEMENTS}");
            problems.refuse(&table.arrays, rule);
        }
        let record_bytes = elements as f64 * samples * BYTES_PER_7038_SAMPLE;
        if record_bytes > f64::from(u32::MAX) {
            let rule = format!(
                "{record_bytes} bytes in one 7038 record; a 7k record holds at most 2^32 - 1"
            );
            problems.refuse(&table.arrays, rule);
        } else if client_queue_bytes.is_some_and(|queue| (queue as f64) < record_bytes) {
            let mib = (record_bytes / f64::from(1 << 20)).ceil() + 1.0;
            let rule = format!("must hold a ping's element samples: at least {mib}");
            problems.refuse(&table.client_queue_mib, rule);
        }
    }
    Some(SevenKSpec {
        listen: listen?,
        device_id: table.id.to()?,
        enumerator: table.enumerator.to()?,
        arrays: chosen?,
        has_common_files: table.file_records.text()? == "common",
        max_packet: table.max_packet_bytes.to()?,
        client_queue_bytes: client_queue_bytes?,
        disconnect_when_full: table.when_full.text()? == "disconnect",
        third_parties: third_parties(&table.third_parties, problems)?,
        max_clients: table.max_clients.to()?,
    })
}
