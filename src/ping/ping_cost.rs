//! Cost of a whole ping: of its methods, and of the stages that are the same whatever these are: gathering, receiver, beams and records.
//!
//! In: a sonar with its methods, a ping's plan, the counts of its scene and the table of costs. Out: [`PingCost`]. Gathering, methods, receiver and beams
//! share the threads; the records of a ping are made by one thread. Not counted: `scene.simplify`, error checks, motion of targets, delivery and page.

use crate::element_synthesis::doppler_hz;
use crate::method_selection::costs::Costs;
use crate::plan;
use crate::work::{Figure, Work};
use echotank_config::spec::{JsfChannels, JsfFormat, OutputSpec, PingDevice, SonarSpec};
use echotank_core::ping::{PingPlan, SceneCounts};
use echotank_imaging::beam::RowLimits;
use echotank_imaging::beam::work::BeamWork;
use echotank_synthesis::array::instrument::InstrumentWork;

/// Results of a ping in the Ping protocol, and points of one side of an Imagenex 872.
const PING_RESULTS: f64 = 1200.0;
const IMAGENEX_POINTS: f64 = 1000.0;

/// Cost estimate of a ping by stage, milliseconds of one core.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PingCost {
    /// Scatterers of the scene.
    pub gather_ms: f64,
    /// Echoes at the elements, by the chosen methods.
    pub methods_ms: f64,
    /// Imperfections, noise, gain and converter of every element.
    pub receiver_ms: f64,
    /// Beams, side-scan lines and bottom detection.
    pub beams_ms: f64,
    /// Records of every output, for a client that takes all of them.
    pub records_ms: f64,
}

/// Cost of a tap of a transducer response, in products of a beamformer: measured at 0.4 ns.
const PRODUCTS_PER_TAP: f64 = 1.6;

impl PingCost {
    /// Of a sonar whose methods cost `methods_ms`; `sonar` has them.
    pub fn new(
        sonar: &SonarSpec,
        plan: &PingPlan,
        scene: &SceneCounts,
        methods_ms: f64,
        costs: &Costs,
    ) -> Self {
        Self {
            gather_ms: costs.ms(&gather(scene)),
            methods_ms,
            receiver_ms: costs.ms(&receiver(sonar, plan)),
            beams_ms: costs.ms(&beams(sonar, plan)),
            records_ms: costs.ms(&records(sonar, plan)),
        }
    }

    /// The stages by name, in their order.
    pub fn stages(&self) -> [(&'static str, f64); 5] {
        [
            ("gather", self.gather_ms),
            ("methods", self.methods_ms),
            ("receiver", self.receiver_ms),
            ("beams", self.beams_ms),
            ("records", self.records_ms),
        ]
    }

    /// On one core.
    pub fn core_ms(&self) -> f64 {
        self.stages().iter().map(|(_, ms)| ms).sum()
    }

    /// Time on several threads, milliseconds; see [`speedup`].
    pub fn wall_ms(&self, threads: usize) -> f64 {
        let handover_ms = if threads > 1 { HANDOVER_MS } else { 0.0 };
        (self.core_ms() - self.records_ms) / speedup(threads) + self.records_ms + handover_ms
    }
}

/// Time of a ping in which threads wake and wait for each other, milliseconds: small pings of `tools/bench rates` take so much more than their work.
const HANDOVER_MS: f64 = 0.5;

/// Time of a ping on one thread over that on several. Threads share memory, hardware threads of one core share arithmetic, and some stages have one
/// thread. The exponent is a fit to four rigs of `tools/bench rates --threads N` on 16 hardware threads: 1.3 to 1.8 with 2 threads, 1.9 to 2.6 with
/// 4, 3.3 to 4.3 with 8, 3.8 to 7.3 with 16.
pub fn speedup(threads: usize) -> f64 {
    (threads.max(1) as f64).powf(0.62)
}

fn gather(scene: &SceneCounts) -> Work {
    let tested = scene.culled + scene.shadowed + scene.scatterers + scene.surface_tested;
    let passed_on = scene.scatterers + scene.surface + scene.images;
    Work::of(Figure::Tile, scene.tiles_used as f64)
        .and(Figure::Made, scene.made as f64)
        .and(Figure::Tested, tested as f64)
        .and(Figure::Gathered, passed_on as f64)
        .and(Figure::SurfaceScatterer, scene.surface_made as f64)
        .and(Figure::WaterScatterer, scene.volume as f64)
        .and(Figure::ReflectedPair, scene.reflected_pairs as f64)
        .and(Figure::Wave, scene.waves as f64)
        .and(Figure::Ray, scene.rays as f64)
}

fn receiver(sonar: &SonarSpec, plan: &PingPlan) -> Work {
    let samples = (elements(sonar) * plan.sample_count) as f64;
    let noise = match sonar.receiver.noise_db {
        Some(_) => samples,
        None => 0.0,
    };
    let doppler_hz = doppler_hz(sonar, plan.sound_speed_m_per_s);
    let instrument = InstrumentWork::of(sonar, doppler_hz);
    Work::of(Figure::Noise, noise)
        .and(Figure::Received, samples * (1.0 + instrument.passes))
        .and(
            Figure::BeamProduct,
            samples * instrument.products * PRODUCTS_PER_TAP,
        )
}

fn elements(sonar: &SonarSpec) -> usize {
    sonar.receive.iter().map(|array| array.elements).sum()
}

fn beams(sonar: &SonarSpec, plan: &PingPlan) -> Work {
    let (samples, c) = (plan.sample_count, plan.sound_speed_m_per_s);
    let limits = RowLimits {
        sample_rate_hz: sonar.receiver.sample_rate_hz,
        samples: plan::max_samples(sonar, c),
        pulse_s: sonar.limits.pulse_duration_s.1,
    };
    let of_pulse = sonar.beams.lines.iter();
    let of_pulse = of_pulse.map(|line| BeamWork::of_line(sonar, line, limits, samples, c));
    let pulse = of_pulse.fold(BeamWork::default(), BeamWork::plus);
    let mut work = pulse;
    for _ in &sonar.more_pulses {
        work = work.plus(pulse);
    }
    let mut detected = 0.0;
    if let Some(fan) = &sonar.beams.fan {
        work = work.plus(BeamWork::of_fan(sonar, fan, limits, samples, c));
        if fan.form.bottom_detection {
            detected = (fan.beams * samples) as f64;
        }
    }
    Work::of(Figure::BeamTransform, work.transforms)
        .and(Figure::BeamProduct, work.products)
        .and(Figure::BeamZone, work.zones)
        .and(Figure::BeamSample, work.samples)
        .and(Figure::BottomSample, detected)
}

fn records(sonar: &SonarSpec, plan: &PingPlan) -> Work {
    let samples = plan.sample_count as f64;
    let window_s = samples / sonar.receiver.sample_rate_hz;
    let elements = |arrays: &[usize]| -> f64 {
        let of = arrays.iter().map(|&array| sonar.receive[array].elements);
        of.sum::<usize>() as f64
    };
    let fan = sonar.beams.fan.as_ref().map_or(0, |fan| fan.beams) as f64;
    let lines = (sonar.beams.lines.len() * (1 + sonar.more_pulses.len())) as f64;
    let of_output = |output: &OutputSpec| match output {
        OutputSpec::SevenK(output) => {
            let iq = elements(&output.arrays) + fan;
            Work::of(Figure::RecordIq, iq * samples).and(Figure::RecordAmplitude, lines * samples)
        }
        OutputSpec::Jsf(output) => match (output.channels, output.format) {
            (JsfChannels::Staves, _) => {
                Work::of(Figure::RecordIq, elements(&output.arrays) * samples)
            }
            (JsfChannels::Sides, JsfFormat::Envelope) => {
                Work::of(Figure::RecordAmplitude, lines * samples)
            }
            (JsfChannels::Sides, _) => Work::of(Figure::RecordIq, lines * samples),
        },
        OutputSpec::Xtf(_) => Work::of(Figure::RecordAmplitude, lines * samples),
        OutputSpec::Imagenex872(_) => Work::of(Figure::RecordAmplitude, lines * IMAGENEX_POINTS),
        OutputSpec::Vita49(output) => match output.passband_rate_hz {
            Some(rate_hz) => Work::of(
                Figure::RecordPassband,
                elements(&output.arrays) * window_s * rate_hz,
            ),
            None => Work::of(Figure::RecordIq, elements(&output.arrays) * samples),
        },
        OutputSpec::Elements(output) => {
            Work::of(Figure::RecordIq, elements(&output.arrays) * samples)
        }
        OutputSpec::Mcap(output) => {
            let of_elements: usize = sonar.receive.iter().map(|array| array.elements).sum();
            let iq = if output.elements {
                of_elements as f64
            } else {
                0.0
            };
            let iq = iq + if output.beams { fan } else { 0.0 };
            let real = if output.image { fan } else { 0.0 };
            let real = real + if output.lines { lines } else { 0.0 };
            Work::of(Figure::RecordIq, iq * samples).and(Figure::RecordAmplitude, real * samples)
        }
        OutputSpec::Sigmf(output) => Work::of(Figure::RecordIq, elements(&output.arrays) * samples),
        OutputSpec::Wav(output) => Work::of(
            Figure::RecordPassband,
            elements(&output.arrays) * window_s * f64::from(output.rate_hz),
        ),
        OutputSpec::Ping(output) => {
            let of = match output.device {
                PingDevice::Omniscan450 { .. } => samples + PING_RESULTS,
                PingDevice::Surveyor240 => fan,
            };
            Work::of(Figure::RecordAmplitude, of)
        }
        OutputSpec::Wbms(_) => Work::of(Figure::RecordAmplitude, fan * samples),
    };
    let all = sonar.outputs.iter().map(of_output);
    all.fold(Work::NONE, |sum, work| sum.plus(&work))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn records_are_made_by_one_thread_and_the_rest_by_all() {
        let cost = PingCost {
            gather_ms: 1.0,
            methods_ms: 5.0,
            receiver_ms: 0.5,
            beams_ms: 1.5,
            records_ms: 3.0,
        };
        assert_eq!(cost.core_ms(), 11.0);
        assert_eq!(cost.wall_ms(1), 11.0);
        for threads in [2, 16] {
            let rest_ms = cost.wall_ms(threads) - 3.0 - HANDOVER_MS;
            assert!((rest_ms * speedup(threads) - 8.0).abs() < 1e-12);
        }
        assert!((1.3..1.8).contains(&speedup(2)) && (3.8..7.3).contains(&speedup(16)));
    }

    #[test]
    fn a_scene_at_rest_costs_its_scatterers() {
        let costs = Costs::committed();
        let scene = SceneCounts {
            tiles_used: 10,
            culled: 300,
            shadowed: 50,
            scatterers: 650,
            ..SceneCounts::default()
        };
        let work = gather(&scene);
        assert_eq!(work[Figure::Made], 0.0);
        assert_eq!(work[Figure::Tested], 1000.0);
        assert_eq!(work[Figure::Gathered], 650.0);
        let made = SceneCounts { made: 100, ..scene };
        let reflected = SceneCounts {
            reflected_pairs: 100,
            ..scene
        };
        let bent = SceneCounts { rays: 100, ..scene };
        let surface = SceneCounts {
            surface_made: 100,
            ..scene
        };
        let water = SceneCounts {
            volume: 100,
            ..scene
        };
        for more in [made, reflected, bent, surface, water] {
            assert!(costs.ms(&gather(&more)) > costs.ms(&work), "{more:?}");
        }
    }
}
