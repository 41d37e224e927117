//! Output to the operator's page: decimated copies of the data of each ping, for [`Feed`].
//!
//! Frames are made before the deadline of the ping and published after all other outputs. Without an open page, each ping makes only a line and its soundings,
//! for the history.

use std::sync::Arc;

use glam::DVec3;
use num_complex::{Complex32, Complex64};
use serde_json::{Value, json};

use super::{Output, OutputError, Report};
use crate::io::control::feed::{Feed, Frame, Scope, ScopeOf};
use crate::io::control::frame::{Kind, frame, levels, max_hold};
use crate::io::record::truth::echo_delay_s;
use echotank_config::spec::SonarSpec;
use echotank_core::frames::angles_from_rotation;
use echotank_core::ping::{Detection, PingOutput, PingPlan, Side};
use echotank_ping::rig::PingSlot;
use echotank_ping::world::SharedSceneSummary;

/// Maximum number of pixels per side of a waterfall line; more than a screen shows.
const MAX_PIXELS: usize = 1000;
/// Maximum number of beams in a fan frame.
const MAX_BEAMS: usize = 256;
/// Maximum number of range bins per beam in a fan frame.
const MAX_BINS: usize = 500;
/// Maximum number of samples in a scope frame: the page computes spectra of up to 16384 points.
const MAX_SAMPLES: usize = 16_384;
/// Maximum number of expected targets in a line frame. The targets nearest to broadside are kept.
const MAX_EXPECTED: usize = 24;
/// Maximum angle from broadside of an expected target, radians.
const MAX_OFF_BROADSIDE_RAD: f64 = 0.35;

/// Context of the page output of one sonar.
pub struct PageContext {
    /// Receives the frames of all sonars.
    pub feed: Arc<Feed>,
    /// Index of the sonar in the configuration.
    pub sonar: u16,
    /// Targets and terrain, once they are placed.
    pub world: SharedSceneSummary,
}

/// Page output of one sonar.
pub(super) struct Page {
    spec: SonarSpec,
    feed: Arc<Feed>,
    sonar: u16,
    world: SharedSceneSummary,
    /// Frames of the encoded ping, published at its deadline.
    pending: Vec<Frame>,
    /// Scratch: squared amplitudes of the current frame.
    power: Vec<f32>,
    /// Scratch: array bytes of the current frame.
    bytes: Vec<u8>,
}

impl Page {
    pub(super) fn new(spec: &SonarSpec, context: PageContext) -> Self {
        Self {
            spec: spec.clone(),
            feed: context.feed,
            sonar: context.sonar,
            world: context.world,
            pending: Vec::new(),
            power: Vec::new(),
            bytes: Vec::new(),
        }
    }

    fn push(&mut self, kind: Kind, scope: Option<Scope>, plan: &PingPlan, text: &Value) {
        let bytes = frame(kind, self.sonar, plan.ping_number, text, &self.bytes);
        self.pending.push(Frame {
            sonar: self.sonar,
            kind,
            scope,
            bytes,
        });
    }

    fn line(&mut self, plan: &PingPlan, output: &PingOutput) {
        let source = LineSource::of(output);
        self.power.clear();
        let mut pixels = [0; 2];
        let mut samples = 0;
        for (side, pixels) in [Side::Port, Side::Starboard].into_iter().zip(&mut pixels) {
            let begin = self.power.len();
            self.power.resize(begin + MAX_PIXELS, 0.0);
            let (n, parts) = source.side(output, side, &mut self.power[begin..]);
            samples = samples.max(n);
            *pixels = parts;
            self.power.truncate(begin + parts);
        }
        self.bytes.clear();
        let low_db = levels(&self.power, &mut self.bytes);
        let first_s = match source {
            LineSource::Lines => 0.0,
            _ => plan.first_sample_s,
        };
        let text = json!({
            "t_ms": plan.transmit_utc.0 as f64 / 1e6,
            "of": source.name(),
            "pixels": pixels,
            "samples": samples,
            "first_s": first_s,
            "rate_hz": self.spec.receiver.sample_rate_hz,
            "c": plan.sound_speed_m_per_s,
            "low_db": low_db,
            "range_m": plan.settings.range_m,
            "altitude_m": self.altitude_m(plan),
            "nav": self.nav(plan),
            "expected": self.expected(plan),
            "model": model(plan, output),
        });
        self.push(Kind::Line, None, plan, &text);
    }

    /// Height of the array of the lines above the seabed below it at the start of the pulse, m. No bottom echo has a shorter slant range over level
    /// ground. `None` without a seabed.
    fn altitude_m(&self, plan: &PingPlan) -> Option<f64> {
        let ground = self.world.get()?.ground.as_ref()?;
        let beams = &self.spec.beams;
        let array = beams.lines.first().map(|line| line.array);
        let array = array.or(beams.fan.as_ref().map(|fan| fan.array));
        let mounting = &self.spec.receive.get(array.unwrap_or(0))?.mounting;
        let at = plan.trajectory.pose_at(0.0).point_m(mounting.position_m);
        Some(ground.down_m(at.x, at.y)? - at.z)
    }

    fn nav(&self, plan: &PingPlan) -> Value {
        let pose = plan.trajectory.pose_at(0.0);
        let (roll, pitch, heading) = angles_from_rotation(pose.world_from_body);
        let at = pose.position_m;
        let ground = self.world.get().and_then(|world| world.ground.as_ref());
        let bottom = ground.and_then(|ground| ground.down_m(at.x, at.y));
        let nav = &plan.nav;
        json!({
            "north": at.x, "east": at.y, "down": at.z,
            "bottom": bottom,
            "lat": nav.latitude_rad.to_degrees(), "lon": nav.longitude_rad.to_degrees(),
            "roll": roll.to_degrees(), "pitch": pitch.to_degrees(), "heading": heading.to_degrees(),
            "heave": nav.heave_down_m,
            "speed": pose.velocity_m_per_s.truncate().length(),
            "position_age": nav.position_age_s, "attitude_age": nav.attitude_age_s,
            "extrapolated": nav.extrapolated,
            "invalid": {
                "position": nav.invalid.position, "heading": nav.invalid.heading,
                "roll_pitch": nav.invalid.roll_pitch, "vertical": nav.invalid.vertical,
            },
            "fix": format!("{:?}", nav.fix),
        })
    }

    /// Targets near broadside within the window, as rows of five values:
    ///
    /// name, side (0 port, 1 starboard), two-way time of the leading edge from the start of the pulse (s), angle from broadside (degrees, positive
    /// ahead), target strength (dB).
    fn expected(&self, plan: &PingPlan) -> Value {
        let Some(world) = self.world.get() else {
            return json!([]);
        };
        let pose = plan.trajectory.pose_at(0.0);
        let rate_hz = self.spec.receiver.sample_rate_hz;
        let window_s = plan.first_sample_s + plan.sample_count as f64 / rate_hz;
        let farthest_m = 0.5 * plan.sound_speed_m_per_s * window_s;
        let mut expected = Vec::new();
        for target in &world.targets {
            let (target_m, _) = target.at(plan.transmit_utc, 0.0);
            if target_m.distance(pose.position_m) > farthest_m + MAX_LEVER_ARM_M {
                continue;
            }
            let body_m = pose.world_from_body.inverse() * (target_m - pose.position_m);
            let (side, array) = self.array_of(body_m);
            let mounting = &self.spec.receive[array].mounting;
            let from_m = body_m - mounting.position_m;
            let broadside = mounting.body_from_array * DVec3::X;
            // Ahead is positive for either direction of the array's axis.
            let sign = if broadside.x < 0.0 { -1.0 } else { 1.0 };
            // A fan lies across the ship, so its expected targets are abeam.
            let along = match broadside.x.abs() > broadside.y.abs() {
                true => sign * from_m.dot(broadside),
                false => from_m.x,
            };
            let off_rad = (along / from_m.length().max(1e-9)).clamp(-1.0, 1.0).asin();
            if off_rad.abs() > MAX_OFF_BROADSIDE_RAD {
                continue;
            }
            let delay_s = echo_delay_s(&self.spec, plan, array, target);
            if delay_s <= window_s {
                expected.push((off_rad, target, side, delay_s));
            }
        }
        expected.sort_by(|a, b| a.0.abs().total_cmp(&b.0.abs()));
        expected.truncate(MAX_EXPECTED);
        let rows = expected.iter().map(|(off_rad, target, side, delay_s)| {
            let side = match side {
                Side::Port => 0,
                Side::Starboard => 1,
            };
            json!([
                target.name,
                side,
                delay_s,
                off_rad.to_degrees(),
                target.target_strength_db
            ])
        });
        rows.collect()
    }

    /// Side of a point in body axes, and index of the receive array of that side.
    fn array_of(&self, body_m: DVec3) -> (Side, usize) {
        let side = match body_m.y < 0.0 {
            true => Side::Port,
            false => Side::Starboard,
        };
        let mut lines = self.spec.beams.lines.iter();
        let line = lines.find(|line| line.side == side).map(|line| line.array);
        let fan = self.spec.beams.fan.as_ref().map(|fan| fan.array);
        (side, line.or(fan).unwrap_or(0))
    }

    fn fan(&mut self, plan: &PingPlan, output: &PingOutput) {
        let Some(beams) = output.beams.first().filter(|beams| beams.samples > 0) else {
            return;
        };
        let group = beams.beams.div_ceil(MAX_BEAMS).max(1);
        let bins = beams.samples.min(MAX_BINS);
        self.power.clear();
        let mut angles_deg = Vec::new();
        let mut row = [0.0; MAX_BINS];
        for first in (0..beams.beams).step_by(group) {
            let last = (first + group).min(beams.beams) - 1;
            let begin = self.power.len();
            self.power.resize(begin + bins, 0.0);
            for beam in first..=last {
                max_hold(beam_powers(beams.beam(beam)), &mut row);
                for (held, new) in self.power[begin..].iter_mut().zip(&row) {
                    *held = held.max(*new);
                }
            }
            let middle_rad = 0.5 * (beams.angle_rad[first] + beams.angle_rad[last]);
            angles_deg.push(middle_rad.to_degrees());
        }
        self.bytes.clear();
        let low_db = levels(&self.power, &mut self.bytes);
        let soundings = output.soundings.iter().map(|s| {
            let by_phase = s.detection == Detection::Phase;
            json!([s.angle_rad.to_degrees(), s.twtt_s, u8::from(by_phase)])
        });
        let text = json!({
            "beams": angles_deg.len(),
            "all_beams": beams.beams,
            "bins": bins,
            "angles": angles_deg,
            "samples": beams.samples,
            "first_s": plan.first_sample_s,
            "rate_hz": self.spec.receiver.sample_rate_hz,
            "c": plan.sound_speed_m_per_s,
            "low_db": low_db,
            "soundings": soundings.collect::<Value>(),
        });
        self.push(Kind::Fan, None, plan, &text);
    }

    /// World positions of the bottom detections: at half the travel time along the angle from the boresight, with the pose at the middle of the
    /// echo's path.
    fn soundings(&mut self, plan: &PingPlan, output: &PingOutput) {
        let Some(fan) = self.spec.beams.fan.as_ref() else {
            return;
        };
        if output.soundings.is_empty() {
            return;
        }
        let mounting = &self.spec.receive[fan.array].mounting;
        let x = mounting.body_from_array * DVec3::X;
        let boresight = mounting.body_from_array * DVec3::Z;
        // Angles are positive to starboard, whichever way the array's x axis points.
        let starboard = if x.y < -1e-9 { -x } else { x };
        self.bytes.clear();
        for sounding in &output.soundings {
            let pose = plan.trajectory.pose_at(0.5 * sounding.twtt_s);
            let range_m = 0.5 * plan.sound_speed_m_per_s * sounding.twtt_s;
            let (sin, cos) = sounding.angle_rad.sin_cos();
            let towards = sin * starboard + cos * boresight;
            let at = pose.point_m(mounting.position_m + range_m * towards);
            for coordinate in at.to_array() {
                self.bytes.extend((coordinate as f32).to_le_bytes());
            }
        }
        self.push(Kind::Soundings, None, plan, &json!({}));
    }

    fn elements(&mut self, plan: &PingPlan, output: &PingOutput) {
        self.bytes.clear();
        let mut arrays = Vec::new();
        for array in &output.elements {
            for element in 0..array.elements {
                let (mut sum, mut peak) = (0.0, 0.0_f64);
                for power in array.element(element).iter().map(|x| x.norm_sqr()) {
                    sum += power;
                    peak = peak.max(power);
                }
                for power in [sum / array.samples.max(1) as f64, peak] {
                    let db = 10.0 * power.max(1e-60).log10();
                    self.bytes.extend((db as f32).to_le_bytes());
                }
            }
            arrays.push(json!({ "elements": array.elements, "saturated": array.saturated }));
        }
        self.push(Kind::Elements, None, plan, &json!({ "arrays": arrays }));
    }

    fn scope(&mut self, scope: Scope, plan: &PingPlan, output: &PingOutput) {
        let (array, index) = (usize::from(scope.array), usize::from(scope.index));
        self.bytes.clear();
        let mut put = |i: f32, q: f32| {
            self.bytes.extend(i.to_le_bytes());
            self.bytes.extend(q.to_le_bytes());
        };
        let part = |all: usize| {
            let first = (scope.first as usize).min(all);
            first..all.min(first + MAX_SAMPLES)
        };
        let mut first_s = plan.first_sample_s;
        let all = match scope.of {
            ScopeOf::Element => {
                let frame = output.elements.get(array).filter(|f| index < f.elements);
                let samples = frame.map_or(&[][..], |frame| frame.element(index));
                for x in &samples[part(samples.len())] {
                    put(x.re as f32, x.im as f32);
                }
                samples.len()
            }
            ScopeOf::Beam => {
                let frame = output.beams.get(array).filter(|f| index < f.beams);
                let samples = frame.map_or(&[][..], |frame| frame.beam(index));
                for x in &samples[part(samples.len())] {
                    put(x.re, x.im);
                }
                samples.len()
            }
            ScopeOf::Line => {
                let line = output.lines.get(array);
                let amplitude = line.map_or(&[][..], |line| &line.amplitude);
                if line.is_some() {
                    // Sample 0 of a line is the start of the pulse.
                    first_s = 0.0;
                }
                for a in &amplitude[part(amplitude.len())] {
                    put(*a, 0.0);
                }
                amplitude.len()
            }
        };
        let text = json!({
            "all": all,
            "first": part(all).start,
            "first_s": first_s,
            "rate_hz": self.spec.receiver.sample_rate_hz,
            "center_hz": plan.pulse.center_frequency_hz,
            "c": plan.sound_speed_m_per_s,
            "complex": scope.of != ScopeOf::Line,
        });
        self.push(Kind::Scope, Some(scope), plan, &text);
    }
}

/// Upper bound of the distance from the reference point to an array, metres.
const MAX_LEVER_ARM_M: f64 = 500.0;

/// Data source of the waterfall lines.
#[derive(Clone, Copy)]
enum LineSource {
    /// Side-scan lines.
    Lines,
    /// Maximum over the beams of each side, without side-scan lines.
    Fan,
    /// Maximum over the elements of the first array, shown to starboard, without beams.
    Elements,
}

impl LineSource {
    fn of(output: &PingOutput) -> Self {
        if !output.lines.is_empty() {
            Self::Lines
        } else if output.beams.iter().any(|beams| beams.beams > 0) {
            Self::Fan
        } else {
            Self::Elements
        }
    }

    fn name(self) -> &'static str {
        match self {
            Self::Lines => "lines",
            Self::Fan => "fan",
            Self::Elements => "elements",
        }
    }

    /// Writes the powers of one side into `into`. Returns the sample count of the row and the number of pixels filled.
    fn side(self, output: &PingOutput, side: Side, into: &mut [f32]) -> (usize, usize) {
        match self {
            Self::Lines => {
                let line = output.lines.iter().find(|line| line.side == side);
                let amplitude = line.map_or(&[][..], |line| &line.amplitude);
                let pixels = max_hold(amplitude.iter().map(|a| a * a), into);
                (amplitude.len(), pixels)
            }
            Self::Fan => {
                let beams = &output.beams[0];
                let of_side = |beam: &usize| (beams.angle_rad[*beam] < 0.0) == (side == Side::Port);
                let rows = (0..beams.beams).filter(of_side);
                max_power(
                    rows.map(|beam| beam_powers(beams.beam(beam))),
                    beams.samples,
                    into,
                )
            }
            Self::Elements => match (side, output.elements.first()) {
                (Side::Starboard, Some(array)) => {
                    let rows = (0..array.elements).map(|element| powers(array.element(element)));
                    max_power(rows, array.samples, into)
                }
                _ => (0, 0),
            },
        }
    }
}

fn powers(row: &[Complex64]) -> impl ExactSizeIterator<Item = f32> {
    row.iter().map(|x| x.norm_sqr() as f32)
}

fn beam_powers(row: &[Complex32]) -> impl ExactSizeIterator<Item = f32> {
    row.iter().map(|x| x.norm_sqr())
}

/// Maximum power over several rows, per pixel.
fn max_power(
    rows: impl Iterator<Item = impl ExactSizeIterator<Item = f32>>,
    samples: usize,
    into: &mut [f32],
) -> (usize, usize) {
    let mut row = [0.0; MAX_PIXELS];
    let pixels = samples.min(into.len());
    into[..pixels].fill(0.0);
    for powers in rows {
        max_hold(powers, &mut row[..pixels]);
        for (held, new) in into.iter_mut().zip(&row) {
            *held = held.max(*new);
        }
    }
    (samples, pixels)
}

/// Selected methods of the ping and size of its scene.
fn model(plan: &PingPlan, output: &PingOutput) -> Value {
    let error_check = output.error_check.map(|c| {
        json!({ "error": c.error, "low": c.low, "high": c.high, "worst": c.worst, "tolerance": c.tolerance, "fault": c.fault })
    });
    json!({
        "path": plan.model.path.name(),
        "doppler": plan.model.doppler.name(),
        "synthesis": plan.model.synthesis.name(),
        "segments": plan.segments.len(),
        "segment_ms": plan.model.segment_s * 1e3,
        "cull_db": plan.model.cull_db,
        "scatterers": output.scene.scatterers,
        "shadowed": output.scene.shadowed,
        "arrivals": output.counts.used,
        "error_check": error_check,
    })
}

impl Output for Page {
    fn addresses(&self) -> Vec<String> {
        Vec::new()
    }

    fn report(&self) -> Arc<dyn Report> {
        Arc::new(PageReport)
    }

    fn encode(&mut self, slot: &PingSlot) {
        let PingSlot { plan, output } = slot;
        self.pending.clear();
        self.line(plan, output);
        self.soundings(plan, output);
        let wanted = self.feed.wanted(self.sonar);
        if wanted.fan {
            self.fan(plan, output);
        }
        if wanted.elements {
            self.elements(plan, output);
        }
        for scope in wanted.scopes {
            self.scope(scope, plan, output);
        }
    }

    fn deliver(&mut self) -> Result<(), OutputError> {
        for frame in self.pending.drain(..) {
            self.feed.publish(frame);
        }
        Ok(())
    }
}

/// Empty report, because the feed counts the frames of all sonars together.
struct PageReport;

impl Report for PageReport {
    fn lines(&self) -> Vec<String> {
        Vec::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::control::feed::Want;
    use crate::io::control::frame::{HEAD_BYTES, STEP_DB};
    use crate::io::record::testing::{output, plan, sonar};
    use echotank_core::ping::Sounding;
    use echotank_core::scene::Target;
    use echotank_ping::world::SceneSummary;

    fn slot(number: u32) -> PingSlot {
        PingSlot {
            plan: plan(number),
            output: output(number),
        }
    }

    fn page(targets: Vec<Target>) -> (Page, Arc<Feed>) {
        let feed = Arc::new(Feed::new(1));
        let world = SharedSceneSummary::default();
        world.get_or_init(|| SceneSummary {
            targets,
            ground: None,
        });
        let context = PageContext {
            feed: feed.clone(),
            sonar: 0,
            world,
        };
        (Page::new(&sonar(), context), feed)
    }

    /// The JSON text and the array bytes of a frame.
    fn parts(frame: &Frame) -> (Value, Vec<u8>) {
        let length = |at| {
            let bytes: [u8; 4] = frame.bytes[at..at + 4].try_into().expect("four");
            u32::from_le_bytes(bytes) as usize
        };
        let text = &frame.bytes[HEAD_BYTES..HEAD_BYTES + length(8)];
        let arrays = frame.bytes[HEAD_BYTES + length(8)..].to_vec();
        assert_eq!(arrays.len(), length(12));
        (serde_json::from_slice(text).expect("JSON"), arrays)
    }

    #[test]
    fn without_an_open_page_a_ping_makes_one_line_frame() {
        let (mut page, feed) = page(Vec::new());
        page.encode(&slot(3));
        assert_eq!(feed.counts().frames, 0, "not before the deadline");
        page.deliver().expect("cannot fail");
        assert_eq!(feed.counts().frames, 1);
    }

    #[test]
    fn line_levels_match_both_sides_within_half_a_quantisation_step() {
        let (mut page, _) = page(Vec::new());
        let slot = slot(3);
        page.encode(&slot);
        let (text, levels) = parts(&page.pending[0]);
        assert_eq!(text["pixels"], json!([20, 20]));
        assert_eq!(
            (&text["of"], &text["samples"]),
            (&json!("lines"), &json!(20))
        );
        let low_db = text["low_db"].as_f64().expect("a number") as f32;
        let sides = slot.output.lines.iter().flat_map(|line| &line.amplitude);
        for (k, (amplitude, level)) in sides.zip(&levels).enumerate() {
            let (want, got) = (
                20.0 * amplitude.log10(),
                low_db + f32::from(*level) * STEP_DB,
            );
            assert!((want - got).abs() <= 0.51 * STEP_DB, "{k}: {got} {want}");
        }
    }

    #[test]
    fn open_pages_receive_the_frames_they_request() {
        let (mut page, feed) = page(Vec::new());
        let scope = |of, array, index| {
            Some(Scope {
                of,
                array,
                index,
                first: 0,
            })
        };
        let want = |scope| Want {
            sonar: 0,
            fan: true,
            elements: true,
            scope,
        };
        let wants = [
            scope(ScopeOf::Element, 1, 2),
            scope(ScopeOf::Beam, 0, 1),
            scope(ScopeOf::Line, 1, 0),
            // An element that does not exist.
            scope(ScopeOf::Element, 9, 9),
        ];
        let _open: Vec<_> = wants
            .into_iter()
            .map(|scope| {
                let mut open = feed.join();
                open.look(want(scope));
                open
            })
            .collect();
        let slot = slot(5);
        page.encode(&slot);
        let kinds: Vec<_> = page.pending.iter().map(|frame| frame.kind).collect();
        assert_eq!(kinds[..3], [Kind::Line, Kind::Fan, Kind::Elements]);
        assert_eq!(kinds[3..], [Kind::Scope; 4]);
        let (fan, levels) = parts(&page.pending[1]);
        assert_eq!((&fan["beams"], &fan["bins"]), (&json!(3), &json!(20)));
        assert_eq!(levels.len(), 60);
        let floats = |bytes: &[u8]| -> Vec<f32> {
            let fours = bytes.chunks_exact(4);
            fours
                .map(|b| f32::from_le_bytes(b.try_into().expect("four")))
                .collect()
        };
        // Root mean square and peak of two and three elements.
        let (_, elements) = parts(&page.pending[2]);
        let elements = floats(&elements);
        assert_eq!(elements.len(), 2 * (2 + 3));
        let row = slot.output.elements[1].element(2);
        let power = row.iter().map(|x| x.norm_sqr()).sum::<f64>() / row.len() as f64;
        let want_db = 10.0 * power.log10();
        assert!((f64::from(elements[8]) - want_db).abs() < 1e-4);
        let (text, samples) = parts(&page.pending[3]);
        assert_eq!((&text["all"], &text["first"]), (&json!(20), &json!(0)));
        let want: Vec<f32> = row
            .iter()
            .flat_map(|x| [x.re as f32, x.im as f32])
            .collect();
        assert_eq!(floats(&samples), want);
        let (none, nothing) = parts(&page.pending[6]);
        assert_eq!((&none["all"], nothing.len()), (&json!(0), 0));
    }

    #[test]
    fn a_target_is_expected_on_its_side_at_its_two_way_time() {
        let slot = slot(1);
        let pose = slot.plan.trajectory.pose_at(0.0);
        // Within the few samples of the test ping: 0.37 m at 40 kHz.
        let abeam = |across_m| Target {
            name: format!("{across_m}"),
            position_m: pose.point_m(DVec3::new(0.5, across_m, 0.8)),
            target_strength_db: 3.0,
            course: None,
        };
        let far = abeam(50.0);
        let (mut page, _) = page(vec![abeam(-0.5), abeam(0.25), far]);
        page.encode(&slot);
        let (text, _) = parts(&page.pending[0]);
        let expected = text["expected"].as_array().expect("a list");
        let of = |name: &str| expected.iter().find(|row| row[0] == name).expect(name);
        assert_eq!(expected.len(), 2, "{expected:?}");
        assert_eq!((&of("-0.5")[1], &of("0.25")[1]), (&json!(0), &json!(1)));
        // Both legs by Pythagoras; the motion of the ship during the echo is negligible.
        let delay_s = of("0.25")[2].as_f64().expect("a number");
        let from_m = DVec3::new(0.0, 0.25 + 0.3, 0.1).length();
        let to_m = DVec3::new(0.0, 0.25 - 0.3, 0.1).length();
        let want_s = (from_m + to_m) / 1500.0;
        assert!((delay_s - want_s).abs() < 2e-6, "{delay_s} {want_s}");
    }

    #[test]
    fn soundings_lie_in_the_world_where_their_angle_and_time_say() {
        let (mut page, _) = page(Vec::new());
        let mut slot = slot(2);
        let sounding = |angle_rad, twtt_s| Sounding {
            beam: 0,
            angle_rad,
            twtt_s,
            error_s: 1e-5,
            detection: Detection::Amplitude,
            level_v: 1.0,
        };
        page.encode(&slot);
        let kinds = |page: &Page| page.pending.iter().map(|f| f.kind).collect::<Vec<_>>();
        assert_eq!(kinds(&page), [Kind::Line], "no detections, no frame");
        slot.output.soundings = vec![sounding(0.0, 0.02), sounding(0.5, 0.024)];
        page.encode(&slot);
        assert_eq!(kinds(&page), [Kind::Line, Kind::Soundings]);
        let (_, bytes) = parts(&page.pending[1]);
        let floats: Vec<f64> = bytes
            .chunks_exact(4)
            .map(|b| f32::from_le_bytes(b.try_into().expect("four")).into())
            .collect();
        // Mounted with a yaw of 0.3 rad: the array's x axis points forward and to starboard.
        for (got, (angle, twtt_s)) in floats.chunks(3).zip([(0.0f64, 0.02), (0.5, 0.024)]) {
            let range_m = 0.5 * 1500.0 * twtt_s;
            let along = range_m * angle.sin();
            let body_m = DVec3::new(0.5, 0.3, 0.7)
                + DVec3::new(
                    along * 0.3f64.cos(),
                    along * 0.3f64.sin(),
                    range_m * angle.cos(),
                );
            let want = slot.plan.trajectory.pose_at(twtt_s / 2.0).point_m(body_m);
            let got = DVec3::from_slice(got);
            assert!(got.distance(want) < 1e-5, "{got} {want}");
        }
    }
}
