//! Teledyne RESON 7k records of a ping, and the session of a client.
//!
//! - [`SevenKEmitter`]: converts a ping's plan and output into the records that clients subscribe to
//! - [`DeviceSheet`]: contents of the record fields
//! - [`quantise`]: conversion of volts to integers
//! - [`session`]: commands and subscriptions of one client; bytes in, records out
//! - [`protocol`]: the server interface to both
//!
//! If a ping has several pulses ([`echotank_core::ping::PulseLines`]), each pulse has its own 7000 and 7007. These records have the
//! ping number and the multi-ping sequence 1, 2, ... The records of the further pulses are sent last. All other records describe
//! the sonar's own pulse.
//!
//! The timestamp of ping records is the end of the transmission (the timestamp of the ping plus the pulse duration), as the DFD
//! specifies. The timestamp of navigation records is the time of their state, which is the start of the pulse.

mod bottom;
pub mod protocol;
pub mod quantise;
pub mod records;
pub mod session;
pub mod stored_settings;

use std::sync::Arc;

use echotank_protocols::sevenk::RecordStamp;
use echotank_protocols::sevenk::records::{
    BeamAngles, BeamSample, CalibratedSide, Rth7007, Rth7018, Rth7038, Rth7057, Rth10038,
    SAMPLE_TYPE_I16, SideSamples, emit_1016, emit_7004, emit_7007, emit_7018_beam_major,
    emit_7038_element_major, emit_7057, emit_10038,
};

use crate::pool::DatagramPool;
use bottom::{Source, Workspace};
use echotank_core::ping::{BeamFrame, ElementFrame, Line, PingOutput, PingPlan, Side};
use echotank_core::pulse::Pulse;
use echotank_core::records::Datagram;
use records::{DeviceSheet, View};
use stored_settings::StoredSettings;

/// Record types of a simulated sonar. The records of a ping are sent in this order, because readers assign records to the
/// preceding record 7000. Record 7610 precedes 7000, so that the sound velocity is known before the first detections.
pub const RECORDS: [u32; 23] = [
    7610, 7000, 7503, 7004, 7027, 7007, 7018, 7028, 7038, 7042, 7057, 7058, 10_038, 1003, 1008,
    1012, 1013, 1015, 1016, 7500, 7001, 7030, 1009,
];
/// Number of leading [`RECORDS`] that belong to a ping. Of the others, 7500 is an echo of a command. 7001 is sent only on request.
/// 7030 and 1009 are sent on request, or once to a client that subscribes.
const PING_RECORDS: usize = 19;
/// Records that common readers of files do not support. MB-System 5.8 skips them with a warning and fails at 7057.
const UNCOMMON_RECORDS: [u32; 4] = [7038, 7042, 7057, 10_038];

/// Set of [`RECORDS`] in an integer, small enough for an atomic.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct RecordSet(u32);

impl RecordSet {
    /// No record.
    pub const EMPTY: Self = Self(0);
    /// All of [`RECORDS`].
    pub const ALL: Self = Self((1 << RECORDS.len()) - 1);

    /// The elements of `ids` that are in [`RECORDS`].
    pub fn of(ids: &[u32]) -> Self {
        let mut set = Self::EMPTY;
        for &id in ids {
            set.insert(id);
        }
        set
    }
    /// Adds a record. Returns false without a change if `id` is not in [`RECORDS`].
    pub fn insert(&mut self, id: u32) -> bool {
        let bit = bit(id);
        self.0 |= bit;
        bit != 0
    }
    /// Removes a record, if present.
    pub fn remove(&mut self, id: u32) {
        self.0 &= !bit(id);
    }
    /// True if the set contains the record.
    pub fn contains(self, id: u32) -> bool {
        self.0 & bit(id) != 0
    }
    /// True if the set is empty.
    pub fn is_empty(self) -> bool {
        self.0 == 0
    }
    /// Records in either set.
    pub fn union(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }
    /// Records in both sets.
    pub fn intersection(self, other: Self) -> Self {
        Self(self.0 & other.0)
    }
    /// Records in this set and not in `other`.
    pub fn without(self, other: Self) -> Self {
        Self(self.0 & !other.0)
    }
    /// Iterates over the record types in the order of [`RECORDS`].
    pub fn iter(self) -> impl Iterator<Item = u32> {
        RECORDS.into_iter().filter(move |&id| self.contains(id))
    }
    /// The set as an integer for an atomic; [`RecordSet::from_bits`] is the inverse.
    pub fn bits(self) -> u32 {
        self.0
    }
    /// The set for an integer from [`RecordSet::bits`].
    pub fn from_bits(bits: u32) -> Self {
        Self(bits & Self::ALL.0)
    }
}

/// Bit of a record type; 0 if it is not in [`RECORDS`].
fn bit(id: u32) -> u32 {
    RECORDS
        .iter()
        .position(|&known| known == id)
        .map_or(0, |at| 1 << at)
}

/// Output counters of one ping or of a run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct EmitCounts {
    /// Number of records.
    pub records: u64,
    /// Total size, bytes.
    pub bytes: u64,
    /// Number of values clipped at the range of their integers.
    pub saturated: u64,
}

impl std::ops::AddAssign for EmitCounts {
    fn add_assign(&mut self, o: Self) {
        self.records += o.records;
        self.bytes += o.bytes;
        self.saturated += o.saturated;
    }
}

/// Converter of pings into 7k records. It owns its buffers and serves one thread.
pub struct SevenKEmitter {
    sheet: Arc<DeviceSheet>,
    /// One pool per ping record, in the order of [`RECORDS`].
    pools: Vec<DatagramPool>,
    element_numbers: Vec<u16>,
    iq_element_major: Vec<[i16; 2]>,
    /// Samples of the fan by beam, once a record of the ping needs them.
    beams: QuantisedBeams,
    port: Vec<u16>,
    starboard: Vec<u16>,
    angles: [Vec<f32>; 4],
    /// Pressures of port and starboard.
    pressures: [Vec<f32>; 2],
    beam_numbers: Vec<u16>,
    single: Vec<[f32; 2]>,
    bottom: Workspace,
    stored: StoredSettings,
    totals: EmitCounts,
}

impl SevenKEmitter {
    /// `waiting_pings` is the number of pings with records in the queues of clients and recorders for which buffers are reused.
    pub fn new(sheet: Arc<DeviceSheet>, waiting_pings: usize) -> Self {
        let elements = u16::try_from(sheet.wire_elements())
            .expect("the configuration limits 7038 to 65535 elements");
        let pulses = 1 + sheet.sonar().more_pulses.len();
        let pools = RECORDS[..PING_RECORDS]
            .iter()
            .map(|&id| {
                let each = if matches!(id, 7000 | 7007) { pulses } else { 1 };
                DatagramPool::new(id, each * (waiting_pings + 1))
            })
            .collect();
        Self {
            element_numbers: (0..elements).collect(),
            sheet,
            pools,
            iq_element_major: Vec::new(),
            beams: QuantisedBeams::default(),
            port: Vec::new(),
            starboard: Vec::new(),
            angles: Default::default(),
            pressures: Default::default(),
            beam_numbers: Vec::new(),
            single: Vec::new(),
            bottom: Workspace::default(),
            stored: StoredSettings::default(),
            totals: EmitCounts::default(),
        }
    }

    /// Contents of the record fields that are constant during a run.
    pub fn sheet(&self) -> &Arc<DeviceSheet> {
        &self.sheet
    }

    /// Sets the stored settings that apply to the pings from now on.
    pub fn set_stored(&mut self, stored: StoredSettings) {
        self.stored = stored;
    }

    /// Records, bytes and clipped values since the emitter was made.
    pub fn totals(&self) -> EmitCounts {
        self.totals
    }

    /// Number of records for which all buffers were in use, so that a new one was allocated.
    pub fn pool_misses(&self) -> u64 {
        self.pools.iter().map(DatagramPool::misses).sum()
    }

    /// Appends the wanted records that this ping has data for, in the order of [`RECORDS`]. After the longest ping, only 7042
    /// with decimated samples or other widths than 16 bits allocates (a list of beams), unless the queues hold more than
    /// `waiting_pings` pings.
    pub fn emit_ping(
        &mut self,
        plan: &PingPlan,
        output: &PingOutput,
        wanted: RecordSet,
        into: &mut Vec<Arc<Datagram>>,
    ) -> EmitCounts {
        let mut counts = EmitCounts::default();
        let mut add = |(record, saturated): (Arc<Datagram>, u64)| {
            counts += EmitCounts {
                records: 1,
                bytes: record.bytes.len() as u64,
                saturated,
            };
            into.push(record);
        };
        self.beams.saturated = None;
        if self.sheet.renew_profile(plan) && wanted.contains(1009) {
            add((Arc::new(self.sheet.profile_1009(plan.stamp_utc)), 0));
        }
        for (place, &id) in RECORDS[..PING_RECORDS].iter().enumerate() {
            if wanted.contains(id)
                && let Some(made) = self.record(place, id, plan, output)
            {
                add(made);
            }
        }
        for number in 0..output.more_lines.len() {
            for id in [7000, 7007] {
                if wanted.contains(id)
                    && let Some(made) = self.further_record(number, id, plan, output)
                {
                    add(made);
                }
            }
        }
        self.totals += counts;
        counts
    }

    /// 7000 or 7007 of the further pulse with index `number`.
    fn further_record(
        &mut self,
        number: usize,
        id: u32,
        plan: &PingPlan,
        output: &PingOutput,
    ) -> Option<(Arc<Datagram>, u64)> {
        let sheet = Arc::clone(&self.sheet);
        let pulse = sheet.sonar().more_pulses.get(number)?.pulse;
        let more = &output.more_lines[number];
        let stamp = sheet.stamp(plan.stamp_utc.plus_s(more.delay_s + plan.pulse.duration_s));
        let sequence = number as u16 + 2;
        let place = RECORDS.iter().position(|&known| known == id)?;
        if id == 7007 {
            return self.side_scan(place, plan, &more.lines, sequence, &stamp);
        }
        let mut view = View::of_plan(plan);
        view.pulse = Pulse {
            duration_s: plan.pulse.duration_s,
            ..pulse
        };
        let width_rad = sheet.receive_beam_width_rad(plan, output.beams.first());
        let mut settings = sheet.settings_7000(plan.ping_number, &view, width_rad);
        self.stored.report_7000(&mut settings);
        settings.multi_ping_sequence = sequence;
        let record = self.pools[place].write(|buf| settings.emit(buf, &stamp));
        Some((record, 0))
    }

    /// 7007 with the lines of one pulse.
    fn side_scan(
        &mut self,
        place: usize,
        plan: &PingPlan,
        lines: &[Line],
        multi_ping_sequence: u16,
        stamp: &RecordStamp,
    ) -> Option<(Arc<Datagram>, u64)> {
        if lines.is_empty() {
            return None;
        }
        let scale_v = self.sheet.full_scale_v();
        let saturated = fill_side(&mut self.port, lines, Side::Port, scale_v)
            + fill_side(&mut self.starboard, lines, Side::Starboard, scale_v);
        // A missing side is filled with zeros.
        let samples = self.port.len().max(self.starboard.len());
        self.port.resize(samples, 0);
        self.starboard.resize(samples, 0);
        let rth = Rth7007 {
            sonar_id: self.sheet.sonar_id(),
            ping_number: plan.ping_number,
            multi_ping_sequence,
            ..Rth7007::default()
        };
        let sides = SideSamples::U16 {
            port: &self.port,
            starboard: &self.starboard,
        };
        let record = self.pools[place].write(|buf| emit_7007(buf, stamp, &rth, &sides));
        Some((record, saturated))
    }

    /// One record and its number of clipped values; `None` if this ping has no data for the record.
    fn record(
        &mut self,
        place: usize,
        id: u32,
        plan: &PingPlan,
        output: &PingOutput,
    ) -> Option<(Arc<Datagram>, u64)> {
        let sheet = Arc::clone(&self.sheet);
        let pool = &mut self.pools[place];
        let ping_stamp = sheet.ping_stamp(plan);
        let nav_stamp = sheet.nav_stamp(plan);
        let view = View::of_plan(plan);
        let exact = |record| Some((record, 0));
        let source = Source {
            plan,
            output,
            sonar: sheet.sonar(),
            stored: &self.stored,
            silent: silent_samples(plan, sheet.sample_rate_hz()),
            stamp: ping_stamp,
        };
        let work = &mut self.bottom;
        match id {
            7027 | 7028 | 7058 if !sheet.detects_bottom() => None,
            7000 => {
                let beam_width_rad = sheet.receive_beam_width_rad(plan, output.beams.first());
                let mut settings = sheet.settings_7000(plan.ping_number, &view, beam_width_rad);
                self.stored.report_7000(&mut settings);
                settings.multi_ping_sequence = own_sequence(output);
                exact(pool.write(|buf| settings.emit(buf, &ping_stamp)))
            }
            7503 => {
                let mut settings = sheet.settings_7503(plan.ping_number, &view);
                self.stored.report_7503(&mut settings);
                exact(pool.write(|buf| settings.emit(buf, &ping_stamp)))
            }
            7004 => {
                let fan = output.beams.first()?;
                fill_angles(&mut self.angles, fan, sheet.along_track_width_rad(&view));
                let [along, across, width_y, width_x] = &self.angles;
                let angles = BeamAngles {
                    along_track_rad: along,
                    across_track_rad: across,
                    width_y_rad: width_y,
                    width_x_rad: width_x,
                };
                exact(pool.write(|buf| emit_7004(buf, &ping_stamp, sheet.sonar_id(), &angles)))
            }
            7027 => exact(pool.write(|buf| bottom::detections(work, &source, buf))),
            7028 => {
                let fan = output.beams.first()?;
                let mut saturated = 0;
                let record =
                    pool.write(|buf| saturated = bottom::snippets_7028(work, &source, fan, buf));
                Some((record, saturated))
            }
            7058 => {
                let fan = output.beams.first()?;
                let array = sheet.sonar().beams.fan.as_ref()?.array;
                let width_rad = sheet.along_track_width_rad(&view);
                exact(pool.write(|buf| {
                    bottom::strengths_7058(work, &source, (fan, array), width_rad, buf)
                }))
            }
            7042 => {
                let fan = output.beams.first()?;
                if bottom::has_all_samples_in_16_bits(source.stored.water_column_flags) {
                    let saturated = self.beams.fill(fan, sheet.full_scale_v());
                    let beams = &self.beams.samples;
                    let record =
                        pool.write(|buf| bottom::beams_7042(work, &source, fan, beams, buf));
                    return Some((record, saturated));
                }
                let mut saturated = 0;
                let record = pool
                    .write(|buf| saturated = bottom::water_column_7042(work, &source, fan, buf));
                Some((record, saturated))
            }
            7057 => {
                if output.lines.is_empty() {
                    return None;
                }
                fill_pressures(&mut self.pressures, &source);
                let [port, starboard] = &self.pressures;
                self.beam_numbers.clear();
                self.beam_numbers.resize(port.len(), 0);
                let side = |samples| CalibratedSide {
                    samples,
                    beams: &self.beam_numbers,
                };
                let rth = Rth7057 {
                    sonar_id: sheet.sonar_id(),
                    ping_number: plan.ping_number,
                    ..Rth7057::default()
                };
                exact(
                    pool.write(|buf| {
                        emit_7057(buf, &ping_stamp, &rth, side(port), side(starboard))
                    }),
                )
            }
            10_038 => {
                let &array = sheet.wire_arrays().first()?;
                let frame = output.elements.iter().find(|frame| frame.array == array)?;
                if plan.sample_count == 0 || frame.elements == 0 {
                    return None;
                }
                self.single.clear();
                self.single
                    .extend(frame.element(0).iter().map(|v| [v.re as f32, v.im as f32]));
                let rth = Rth10038 {
                    ping_number: plan.ping_number,
                    mean_sound_velocity_m_per_s: plan.sound_speed_m_per_s as f32,
                    sample_rate_hz: sheet.sample_rate_hz() as f32,
                    effective_pulse_length_s: plan.pulse.duration_s as f32,
                    start_sample_delay_s: plan.first_sample_s as f32,
                    full_scale: sheet.full_scale_v() as f32,
                    ..Rth10038::default()
                };
                exact(pool.write(|buf| emit_10038(buf, &ping_stamp, &rth, &self.single)))
            }
            7007 => self.side_scan(
                place,
                plan,
                &output.lines,
                own_sequence(output),
                &ping_stamp,
            ),
            7018 => {
                let fan = output.beams.first()?;
                let before = silent_samples(plan, sheet.sample_rate_hz());
                let saturated = self.beams.fill(fan, sheet.full_scale_v());
                let rth = Rth7018 {
                    sonar_id: sheet.sonar_id(),
                    ping_number: plan.ping_number,
                    multi_ping_sequence: 0,
                    beams: fan.beams as u16,
                    samples: (before + fan.samples) as u32,
                };
                let beams = &self.beams.samples;
                let record =
                    pool.write(|buf| emit_7018_beam_major(buf, &ping_stamp, &rth, before, beams));
                Some((record, saturated))
            }
            7038 => {
                let samples = plan.sample_count;
                if samples == 0 || sheet.wire_arrays().is_empty() {
                    return None;
                }
                self.iq_element_major.clear();
                let mut saturated = 0;
                for &array in sheet.wire_arrays() {
                    let frame = output.elements.iter().find(|frame| frame.array == array)?;
                    saturated += fill_elements(
                        &mut self.iq_element_major,
                        frame,
                        samples,
                        sheet.full_scale_v(),
                    );
                }
                let elements = self.element_numbers.len();
                let start = silent_samples(plan, sheet.sample_rate_hz()) as u32;
                let rth = Rth7038 {
                    sonar_serial: sheet.sonar_id(),
                    ping_number: plan.ping_number,
                    channel_count: sheet.receive_elements() as u16,
                    samples: start + samples as u32,
                    elements: elements as u16,
                    start_sample: start,
                    stop_sample: start + samples as u32 - 1,
                    sample_type: SAMPLE_TYPE_I16,
                };
                let record = pool.write(|buf| {
                    emit_7038_element_major(
                        buf,
                        &ping_stamp,
                        &rth,
                        &self.element_numbers,
                        &self.iq_element_major,
                    );
                });
                Some((record, saturated))
            }
            7610 => {
                let sound = records::sound_velocity_7610(plan.sound_speed_m_per_s);
                exact(pool.write(|buf| sound.emit(buf, &ping_stamp)))
            }
            1003 => {
                let position = records::position_1003(&plan.nav);
                exact(pool.write(|buf| position.emit(buf, &nav_stamp)))
            }
            // Sensor records have no validity flag. They are omitted if the values of the sensor are invalid.
            1008 if plan.nav.invalid.vertical => None,
            1012 if plan.nav.invalid.roll_pitch || plan.nav.invalid.vertical => None,
            1013 if plan.nav.invalid.heading => None,
            1008 => {
                let depth = records::depth_1008(plan.sensor.still_depth_m?);
                exact(pool.write(|buf| depth.emit(buf, &nav_stamp)))
            }
            1012 => {
                let attitude = records::roll_pitch_heave_1012(&plan.nav);
                exact(pool.write(|buf| attitude.emit(buf, &nav_stamp)))
            }
            1013 => {
                let heading = records::heading_1013(&plan.nav);
                exact(pool.write(|buf| heading.emit(buf, &nav_stamp)))
            }
            1015 => {
                let navigation = records::navigation_1015(&plan.nav);
                exact(pool.write(|buf| navigation.emit(buf, &nav_stamp)))
            }
            1016 => {
                let sets = [records::attitude_1016(&plan.nav)];
                exact(pool.write(|buf| emit_1016(buf, &nav_stamp, &sets)))
            }
            other => unreachable!("{other} is not a ping record"),
        }
    }
}

/// Multi-ping sequence number of the sonar's own pulse; 0 for a single pulse.
fn own_sequence(output: &PingOutput) -> u16 {
    u16::from(!output.more_lines.is_empty())
}

/// Number of samples between the start of the pulse and the first computed sample. Records count samples from range 0.
fn silent_samples(plan: &PingPlan, sample_rate_hz: f64) -> usize {
    (plan.first_sample_s * sample_rate_hz).round().max(0.0) as usize
}

fn fill_angles(angles: &mut [Vec<f32>; 4], fan: &BeamFrame, along_track_width_rad: f64) {
    let [along, across, width_y, width_x] = angles;
    along.clear();
    along.resize(fan.beams, 0.0);
    across.clear();
    across.extend(fan.angle_rad.iter().map(|&a| a as f32));
    width_y.clear();
    width_y.resize(fan.beams, along_track_width_rad as f32);
    width_x.clear();
    width_x.extend(fan.width_rad.iter().map(|&w| w as f32));
}

fn fill_side(counts: &mut Vec<u16>, lines: &[Line], side: Side, full_scale_v: f64) -> u64 {
    counts.clear();
    lines
        .iter()
        .find(|line| line.side == side)
        .map_or(0, |line| {
            quantise::line(&line.amplitude, full_scale_v, counts)
        })
}

/// Writes both sides as sound pressure at the array, uPa (rms), without sensitivity and gains. A missing side is filled with zeros.
fn fill_pressures(sides: &mut [Vec<f32>; 2], source: &Source<'_>) {
    let metres_per_sample =
        0.5 * source.plan.sound_speed_m_per_s / source.sonar.receiver.sample_rate_hz;
    for (pressures, side) in sides.iter_mut().zip([Side::Port, Side::Starboard]) {
        pressures.clear();
        let lines = &source.sonar.beams.lines;
        let array = lines.iter().find(|line| line.side == side);
        let line = source.output.lines.iter().find(|line| line.side == side);
        let (Some(array), Some(line)) = (array, line) else {
            continue;
        };
        pressures.extend(line.amplitude.iter().enumerate().map(|(k, &volts)| {
            let range_m = k as f64 * metres_per_sample;
            let gain = 10_f64.powf(source.gain_db(array.array, range_m) / 20.0);
            (f64::from(volts) / gain) as f32
        }));
    }
    let samples = sides.iter().map(Vec::len).max().unwrap_or(0);
    for pressures in sides {
        pressures.resize(samples, 0.0);
    }
}

/// Magnitudes and phases of the fan of one ping, for the records that share them.
#[derive(Default)]
struct QuantisedBeams {
    /// By beam, then by sample.
    samples: Vec<BeamSample>,
    /// Number of clipped magnitudes; `None` if the samples are those of an earlier ping.
    saturated: Option<u64>,
}

impl QuantisedBeams {
    /// Converts the samples of the fan once per ping. Returns the number of clipped magnitudes.
    fn fill(&mut self, fan: &BeamFrame, full_scale_v: f64) -> u64 {
        let convert = || quantise::beams(&fan.iq, full_scale_v, &mut self.samples);
        *self.saturated.get_or_insert_with(convert)
    }
}

/// Writes the elements of 7038. All frames of a ping must have `samples` samples.
fn fill_elements(
    counts: &mut Vec<[i16; 2]>,
    frame: &ElementFrame,
    samples: usize,
    full_scale_v: f64,
) -> u64 {
    debug_assert_eq!(frame.samples, samples, "array {}", frame.array);
    (0..frame.elements)
        .map(|e| quantise::iq(frame.element(e), full_scale_v, counts))
        .sum()
}
