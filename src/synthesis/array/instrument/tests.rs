use std::f64::consts::{PI, SQRT_2, TAU};
use std::path::Path;

use glam::{DQuat, DVec3};

use super::*;
use echotank_config::{AnyFiles, parse};
use echotank_core::arrays::{Pattern, ReceiverFilter};
use echotank_core::frames::{Trajectory, rotation_from_angles};
use echotank_core::instrument::{
    Crosstalk, ElementError, Resonance, ResponsePoint, SecondSonar, Tone, ToneEntry,
    TransducerResponse,
};
use echotank_core::pulse::PulseKind;
use echotank_core::testing::plan_at_rest;
use echotank_core::time::UtcNs;

const CARRIER_HZ: f64 = 100e3;
const RATE_HZ: f64 = 20e3;
const C: f64 = 1500.0;
const SAMPLES: usize = 2000;

/// Sonar with two arrays of four omnidirectional elements, whose transmitter lies 0.9 m behind the first.
fn sonar(instrument: Instrument) -> SonarSpec {
    let text = r#"
[[nav.source]]
name = "gnss"
kind = "udp"
listen = "127.0.0.1:10110"
[[sonar]]
name = "main"
[sonar.pulse]
kind = "cw"
center_frequency_khz = 100.0
duration_ms = 2.0
[[sonar.transmit]]
name = "tx"
position_m = [-0.9, 0.0, 0.0]
[[sonar.receive]]
name = "port"
elements = 4
spacing_m = 0.05
element_pattern = "omnidirectional"
sensitivity_db = -180.0
[[sonar.receive]]
name = "starboard"
elements = 3
spacing_m = 0.05
position_m = [0.0, 0.4, 0.0]
element_pattern = "omnidirectional"
sensitivity_db = -180.0
[sonar.receiver]
sample_rate_khz = 20.0
noise_db = "none"
[sonar.ping]
range_m = 70.0
rate_hz = 5.0
source_level_db = 200.0
"#;
    let rig = parse(text, Path::new("."), &AnyFiles).unwrap_or_else(|why| panic!("{why}"));
    let mut spec = rig.sonars.into_iter().next().expect("a sonar");
    spec.instrument = Some(instrument);
    spec
}

fn design(spec: &SonarSpec) -> FilterDesign {
    FilterDesign {
        pulse: spec.pulse,
        sample_rate_hz: RATE_HZ,
        doppler_hz: 1400.0,
        oversample: 48,
    }
}

fn made(spec: &SonarSpec) -> ElementInstrument {
    let filter = match spec.receiver.filter {
        ReceiverFilter::None => None,
        ReceiverFilter::Fir => Some(design(spec)),
    };
    let sizes = InstrumentSizes {
        filter,
        doppler_hz: 1400.0,
        max_samples: SAMPLES,
    };
    let made = ElementInstrument::new(spec, sizes).unwrap_or_else(|why| panic!("{why}"));
    made.expect("an instrument")
}

fn plan(spec: &SonarSpec, ping_number: u32) -> PingPlan {
    let mut plan = plan_at_rest(&spec.pulse, SAMPLES, C);
    plan.settings.source_level_db = 200.0;
    plan.ping_number = ping_number;
    plan.transmit_utc = UtcNs(1_700_000_000_000_000_000 + i64::from(ping_number) * 200_000_000);
    plan
}

/// Samples of an element without echoes.
fn silence(
    instrument: &mut ElementInstrument,
    plan: &PingPlan,
    array: usize,
    element: usize,
) -> Vec<Complex64> {
    let mut iq = vec![Complex64::ZERO; plan.sample_count];
    instrument.prepare(plan);
    instrument.add_to_element(plan, array, element, &mut iq, &mut Vec::new());
    instrument.add_tones(&mut iq);
    iq
}

fn db(amplitude: f64) -> f64 {
    20.0 * amplitude.log10()
}

fn leaking(q: Option<f64>) -> Instrument {
    Instrument {
        leakage: Some(Leakage {
            level_db: -60.0,
            ring_down: q.map(|q| Resonance {
                q,
                frequency_hz: CARRIER_HZ,
            }),
        }),
        ..Instrument::default()
    }
}

/// Ring-down of a resonance at the carrier: the closed form of a first-order envelope, 1 - exp(-t/tau) in the pulse and a decay after it.
fn ring_down(q: f64, t_s: f64, duration_s: f64) -> f64 {
    let decay_s = q / (PI * CARRIER_HZ);
    match t_s {
        t if t < 0.0 => 0.0,
        t if t < duration_s => 1.0 - (-t / decay_s).exp(),
        t => (1.0 - (-duration_s / decay_s).exp()) * (-(t - duration_s) / decay_s).exp(),
    }
}

#[test]
fn the_pulse_leaks_after_the_way_to_the_element_and_rings_down_with_q() {
    for q in [30.0, 150.0] {
        let mut spec = sonar(leaking(Some(q)));
        spec.receiver.filter = ReceiverFilter::None;
        let plan = plan(&spec, 1);
        let mut instrument = made(&spec);
        for element in 0..4 {
            let way_m = 0.9 + 0.05 * (element as f64 - 1.5);
            let got = silence(&mut instrument, &plan, 0, element);
            // 200 dB - 60 dB - 180 dB.
            let volts = 10f64.powf(-40.0 / 20.0);
            let turned = Complex64::from_polar(1.0, -TAU * CARRIER_HZ * way_m / C);
            let mut compared = 0;
            for (k, got) in got.iter().enumerate() {
                let t_s = k as f64 / RATE_HZ - way_m / C;
                let want = volts * ring_down(q, t_s, 2e-3);
                // Corners are rounded over three of sixteen points per sample.
                let from_corner_s = t_s.abs().min((t_s - 2e-3).abs());
                if from_corner_s > 0.25 / RATE_HZ {
                    assert!(
                        (got - want * turned).norm() < 2e-3 * volts,
                        "{q} {element} {k}"
                    );
                    compared += usize::from(want > 1e-4 * volts);
                }
                let ring_s = t_s - 2e-3;
                if ring_s > 0.0 && want > 1e-6 * volts {
                    // Within 0.5 dB at every sample down to -120 dB.
                    assert!(
                        (db(got.norm()) - db(want)).abs() < 0.5,
                        "{q} {k}: {got} {want}"
                    );
                }
            }
            assert!(compared > 40, "{compared}");
        }
    }
}

/// Through the receiver filter: the same as its convolution sum at the instants of the element, at a density of 48 points per sample.
#[test]
fn the_leaked_pulse_passes_the_receiver_filter() {
    for (q, taper) in [(None, 0.0), (None, 0.3), (Some(40.0), 0.0)] {
        let mut spec = sonar(leaking(q));
        spec.pulse.taper = taper;
        let filter = design(&spec).decimator().expect("fits");
        let plan = plan(&spec, 1);
        let got = silence(&mut made(&spec), &plan, 1, 2);
        let way_m = DVec3::new(0.95, 0.4, 0.0).length();
        let first_s = filter.dense_first_s(-way_m / C);
        let dense: Vec<Complex64> = (0..filter.dense_len(SAMPLES))
            .map(|k| first_s + k as f64 / filter.dense_rate_hz())
            .map(|t_s| match q {
                Some(q) => ring_down(q, t_s, 2e-3).into(),
                None => spec.pulse.envelope(t_s),
            })
            .collect();
        let mut want = vec![Complex64::ZERO; SAMPLES];
        filter.apply(&dense, &mut want);
        let turned = Complex64::from_polar(1e-2, -TAU * CARRIER_HZ * way_m / C);
        let off = got.iter().zip(&want).map(|(g, w)| (g - w * turned).norm());
        let off = off.fold(0.0, f64::max) / 1e-2;
        println!("{q:?}, taper {taper}: {off:.1e}");
        // Edges of the sum lie on one of 48 points.
        assert!(off < 5e-3, "{q:?} {taper}: {off:e}");
        assert!(got.iter().any(|v| v.norm() > 0.9e-2));
    }
}

#[test]
fn another_pulse_length_leaks_as_long() {
    let spec = sonar(leaking(None));
    let mut spec = SonarSpec {
        limits: echotank_config::spec::LimitsSpec {
            pulse_duration_s: (1e-3, 4e-3),
            ..spec.limits
        },
        ..spec
    };
    spec.receiver.filter = ReceiverFilter::None;
    let mut instrument = made(&spec);
    for duration_s in [2e-3, 1e-3, 4e-3, 2e-3] {
        let mut plan = plan(&spec, 1);
        plan.settings.pulse_duration_s = duration_s;
        plan.pulse.duration_s = duration_s;
        let got = silence(&mut instrument, &plan, 0, 0);
        let heard = got.iter().filter(|v| v.norm() > 0.0).count() as f64 / RATE_HZ;
        assert!(
            (heard - duration_s).abs() < 1.01 / RATE_HZ,
            "{heard} {duration_s}"
        );
    }
}

#[test]
fn a_response_filter_is_that_of_its_resonance_or_table_in_the_band() {
    let point = |khz: f64, level_db: f64, phase_deg: f64| ResponsePoint {
        frequency_hz: khz * 1e3,
        level_db,
        phase_rad: phase_deg.to_radians(),
    };
    let table = [
        point(80.0, -20.0, 100.0),
        point(95.0, -3.0, 30.0),
        point(101.0, 0.0, -10.0),
        point(108.0, -6.0, -60.0),
        point(120.0, -25.0, -100.0),
    ];
    let resonance = |q, frequency_hz| TransducerResponse::Resonance(Resonance { q, frequency_hz });
    for (name, response) in [
        ("Q 3", resonance(3.0, 100e3)),
        ("Q 20 beside", resonance(20.0, 103e3)),
        ("Q 100", resonance(100.0, 100e3)),
        ("table", TransducerResponse::Table(table.to_vec())),
    ] {
        let pass_hz = 8e3;
        let filter =
            ResponseFilter::design(&response, CARRIER_HZ, pass_hz, RATE_HZ).expect("rings out");
        let offsets = (-400..=400).map(|k| pass_hz * f64::from(k) / 400.0);
        let largest = offsets.clone().map(|f| response.at(CARRIER_HZ + f).norm());
        let largest = largest.fold(0.0, f64::max);
        let off = offsets.map(|f| (filter.gain(f, RATE_HZ) - response.at(CARRIER_HZ + f)).norm());
        let off = off.fold(0.0, f64::max) / largest;
        println!(
            "{name}: {} taps, {} ahead, error {off:.1e}",
            filter.taps(),
            filter.lookahead()
        );
        assert!(off < 1.5 * response::ERROR, "{name}: {off:e}");
    }
    let endless = resonance(1000.0, 10e3);
    assert!(ResponseFilter::design(&endless, 10e3, 4e3, RATE_HZ).is_none());
}

/// A tone inside a long record has the gain and phase of the response; the ends of the record see zeros.
#[test]
fn samples_pass_the_response_and_every_block_gives_the_same() {
    let response = TransducerResponse::Resonance(Resonance {
        q: 25.0,
        frequency_hz: 102e3,
    });
    let mut spec = sonar(Instrument {
        response: Some(response.clone()),
        ..Instrument::default()
    });
    spec.receiver.filter = ReceiverFilter::None;
    let plan = plan(&spec, 1);
    let mut instrument = made(&spec);
    instrument.prepare(&plan);
    let offset_hz = 1.3e3;
    let tone = |k: usize| waveform::turn(offset_hz * k as f64 / RATE_HZ);
    let pass = |count: usize| {
        let mut iq: Vec<_> = (0..count).map(tone).collect();
        instrument.add_to_element(&plan, 0, 1, &mut iq, &mut Vec::new());
        iq
    };
    let whole = pass(SAMPLES);
    let gain = response.at(CARRIER_HZ + offset_hz);
    for (k, got) in whole.iter().enumerate().take(SAMPLES - 300).skip(300) {
        assert!(
            (got - gain * tone(k)).norm() < 2.0 * response::ERROR,
            "{k}: {got}"
        );
    }
    // The start of a record depends on its end only as far as the filter looks ahead.
    let ahead = instrument.lookahead();
    for count in [37, 512, 513, 1111] {
        assert_eq!(pass(count + ahead)[..count], whole[..count]);
    }
}

/// A resonance that rings for a minute has a table as long as a ping.
#[test]
fn a_ring_down_ends_with_the_longest_ping() {
    let mut spec = sonar(leaking(None));
    spec.instrument = Some(Instrument {
        leakage: Some(Leakage {
            level_db: 0.0,
            ring_down: Some(Resonance {
                q: 1000.0,
                frequency_hz: 100.0,
            }),
        }),
        ..Instrument::default()
    });
    let plan = plan(&spec, 1);
    let mut instrument = made(&spec);
    let got = silence(&mut instrument, &plan, 0, 0);
    let (_, last_s) = instrument.leaks[0].waveform.span_s();
    assert!((last_s - 0.1).abs() < 0.02, "{last_s} s");
    assert!(got.iter().all(|v| v.re.is_finite() && v.im.is_finite()));
}

/// Two-sided probability of a Kolmogorov-Smirnov distance (Stephens 1970).
fn kolmogorov(mut values: Vec<f64>, distribution: impl Fn(f64) -> f64) -> f64 {
    values.sort_by(f64::total_cmp);
    let n = values.len() as f64;
    let distance = values.iter().enumerate().map(|(i, &x)| {
        let cdf = distribution(x);
        (cdf - i as f64 / n)
            .abs()
            .max((cdf - (i + 1) as f64 / n).abs())
    });
    let lambda = (n.sqrt() + 0.12 + 0.11 / n.sqrt()) * distance.fold(0.0, f64::max);
    let terms = (1..100).map(|k| {
        let k = f64::from(k);
        (-1f64).powf(k - 1.0) * (-2.0 * k * k * lambda * lambda).exp()
    });
    (2.0 * terms.sum::<f64>()).clamp(0.0, 1.0)
}

/// Cumulative normal distribution (Abramowitz and Stegun 1964, 7.1.26).
fn normal(x: f64) -> f64 {
    let t = 1.0 / (1.0 + 0.327_591_1 * x.abs() / SQRT_2);
    let series = 0.254_829_592
        + t * (-0.284_496_736 + t * (1.421_413_741 + t * (-1.453_152_027 + t * 1.061_405_429)));
    let tail = 0.5 * t * series * (-0.5 * x * x).exp();
    if x < 0.0 { tail } else { 1.0 - tail }
}

#[test]
fn element_gains_and_phases_are_normal_and_the_same_in_every_ping() {
    let spread = ElementSpread {
        gain_db: 0.7,
        phase_rad: 0.1,
        seed: 5,
        measured: Vec::new(),
    };
    let mut spec = sonar(Instrument {
        element_spread: spread.clone(),
        ..Instrument::default()
    });
    spec.receive[0].elements = 4000;
    let gains = element_gains(&spec, &spread);
    assert_eq!((gains[0].len(), gains[1].len()), (4000, 3));
    let levels: Vec<f64> = gains[0].iter().map(|g| db(g.norm()) / 0.7).collect();
    let phases: Vec<f64> = gains[0].iter().map(|g| g.arg() / 0.1).collect();
    let shared: f64 = levels.iter().zip(&phases).map(|(a, b)| a * b).sum::<f64>() / 4000.0;
    assert!(shared.abs() < 5.0 / 4000f64.sqrt(), "{shared}");
    for (name, values) in [("gain", levels), ("phase", phases)] {
        let p = kolmogorov(values, normal);
        println!("{name}: p = {p:.2}");
        assert!(p > 0.01, "{name}: p = {p}");
    }
    // Another ping and another number of elements leave an element as it is.
    spec.receive[0].elements = 4;
    let mut instrument = made(&spec);
    for ping in [1, 2] {
        let plan = plan(&spec, ping);
        instrument.prepare(&plan);
        let mut iq = vec![Complex64::ONE; 10];
        instrument.add_to_element(&plan, 0, 2, &mut iq, &mut Vec::new());
        assert_eq!(iq, vec![gains[0][2]; 10]);
    }
    let other = ElementSpread {
        seed: 6,
        ..spread.clone()
    };
    assert_ne!(element_gains(&spec, &other)[0][2], gains[0][2]);
    spec.name = "second head".into();
    assert_ne!(element_gains(&spec, &spread)[0][2], gains[0][2]);
}

#[test]
fn measured_element_errors_are_used_as_given() {
    let error = ElementError {
        array: 1,
        element: 2,
        gain_db: -3.0,
        phase_rad: 0.25,
    };
    let spec = sonar(Instrument {
        element_spread: ElementSpread {
            measured: vec![error],
            ..ElementSpread::default()
        },
        ..Instrument::default()
    });
    let gains = made(&spec).gains;
    assert_eq!(gains[0], vec![Complex64::ONE; 4]);
    assert!((db(gains[1][2].norm()) + 3.0).abs() < 1e-12);
    assert!((gains[1][2].arg() - 0.25).abs() < 1e-12);
}

#[test]
fn neighbours_and_arrays_couple_by_their_levels() {
    let spec = sonar(Instrument {
        crosstalk: Crosstalk {
            elements_db: Some(-20.0),
            arrays_db: Some(-40.0),
        },
        ..Instrument::default()
    });
    let mut instrument = made(&spec);
    let count = 5;
    // A signal of its own in every element.
    let own = |array: usize, element: usize| {
        let value = Complex64::new(1.0 + element as f64, 10.0 * array as f64 - 3.0);
        vec![value; count]
    };
    for _ in 0..2 {
        let mut frames: Vec<ElementFrame> = [4, 3]
            .into_iter()
            .enumerate()
            .map(|(array, elements)| ElementFrame {
                array,
                elements,
                samples: count,
                iq: (0..elements).flat_map(|e| own(array, e)).collect(),
                saturated: 0,
            })
            .collect();
        instrument.couple(&mut frames);
        for (array, elements) in [(0, 4), (1, 3)] {
            for e in 0..elements {
                let mut want = own(array, e)[0];
                if e > 0 {
                    want += own(array, e - 1)[0] * 0.1;
                }
                if e + 1 < elements {
                    want += own(array, e + 1)[0] * 0.1;
                }
                let others = [4, 3][1 - array];
                if e < others {
                    want += own(1 - array, e)[0] * 0.01;
                }
                for got in frames[array].element(e) {
                    assert!((got - want).norm() < 1e-12, "{array} {e}: {got} {want}");
                }
            }
        }
    }
}

fn tone(frequency_hz: f64, entry: ToneEntry) -> Instrument {
    Instrument {
        tones: vec![Tone {
            frequency_hz,
            level_db: -30.0,
            phase_rad: 0.4,
            entry,
        }],
        ..Instrument::default()
    }
}

/// Amplitude at an offset from the carrier, from samples of a whole number of periods.
fn line(iq: &[Complex64], offset_hz: f64) -> Complex64 {
    let turned = iq.iter().enumerate();
    let sum: Complex64 = turned
        .map(|(k, x)| x * waveform::turn(-offset_hz * k as f64 / RATE_HZ))
        .sum();
    sum / iq.len() as f64
}

#[test]
fn tones_at_the_input_pass_the_receiver_filter_and_alias_without_one() {
    let volts = 10f64.powf(-1.5);
    for (filter, khz, seen_khz) in [
        (ReceiverFilter::Fir, 101.0, Some(1.0)),
        (ReceiverFilter::Fir, 94.5, Some(-5.5)),
        (ReceiverFilter::Fir, 150.0, None),
        (ReceiverFilter::Fir, 0.05, None),
        // A multiple of the rate of the filter's points from the carrier.
        (ReceiverFilter::Fir, 421.0, None),
        (ReceiverFilter::None, 94.5, Some(-5.5)),
        (ReceiverFilter::None, 113.0, Some(-7.0)),
        (ReceiverFilter::None, 150.0, Some(10.0)),
    ] {
        let mut spec = sonar(tone(1e3 * khz, ToneEntry::Input));
        spec.receiver.filter = filter;
        let plan = plan(&spec, 1);
        let got = silence(&mut made(&spec), &plan, 0, 0);
        match seen_khz {
            Some(seen_khz) => {
                let passed = match filter {
                    ReceiverFilter::None => 1.0,
                    ReceiverFilter::Fir => {
                        let filter = design(&spec).decimator().expect("fits");
                        filter.gain(1e3 * khz - CARRIER_HZ)
                    }
                };
                let level_db = db(line(&got, 1e3 * seen_khz).norm() / passed);
                assert!((level_db + 30.0).abs() < 0.01, "{khz} kHz: {level_db}");
            }
            None => {
                let most = got.iter().map(|v| v.norm()).fold(0.0, f64::max);
                assert!(most < 1e-4 * volts, "{khz} kHz: {:.0} dB", db(most / volts));
            }
        }
    }
}

#[test]
fn the_phase_of_a_tone_runs_on_from_ping_to_ping() {
    // Its phase at the instant of the pulse, from integers: cycles in 1.7e9 s and a multiple of 0.2 s.
    let hertz = 101_003.25;
    let spec = sonar(tone(hertz, ToneEntry::Input));
    for number in [1, 2, 7] {
        let plan = plan(&spec, number);
        let got = silence(&mut made(&spec), &plan, 0, 3);
        let quarter_ns = i128::from(plan.transmit_utc.0) * 404_013; // cycles times 4e9
        let cycles = (quarter_ns.rem_euclid(4_000_000_000)) as f64 / 4e9;
        let want = Complex64::from_polar(1.0, TAU * cycles + 0.4);
        let start = got[0] / got[0].norm();
        assert!((start - want).norm() < 1e-4, "{number}: {start} {want}");
    }
}

#[test]
fn tones_in_baseband_are_real_in_i_and_q() {
    let spec = sonar(tone(50.0, ToneEntry::Baseband));
    let plan = plan(&spec, 1);
    let got = silence(&mut made(&spec), &plan, 0, 0);
    let rms = |part: fn(&Complex64) -> f64| {
        (got.iter().map(|v| part(v).powi(2)).sum::<f64>() / got.len() as f64).sqrt()
    };
    // Five periods of 20 ms.
    for level_db in [db(rms(|v| v.re)), db(rms(|v| v.im))] {
        assert!((level_db + 30.0).abs() < 1e-6, "{level_db}");
    }
    assert!(got.iter().all(|v| v.re == v.im));
}

fn second(period_s: f64, drift_ppm: f64) -> SecondSonar {
    SecondSonar {
        pulse: Pulse {
            kind: PulseKind::LfmDown,
            center_frequency_hz: 101.5e3,
            bandwidth_hz: 4e3,
            duration_s: 3e-3,
            taper: 0.2,
        },
        period_s,
        offset_s: 0.0123,
        drift_ppm,
        bearing_rad: 1.1,
        depression_rad: 0.2,
        level_db: 140.0,
    }
}

fn hearing(second: SecondSonar) -> SonarSpec {
    sonar(Instrument {
        second_sonars: vec![second],
        ..Instrument::default()
    })
}

/// The pulse at an element in motion, from its definition: the phase of the passband at the element's true place, without linearised delays.
#[test]
fn a_second_sonar_arrives_as_a_plane_wave_at_elements_in_motion() {
    let second = second(0.5, 0.0);
    let mut spec = hearing(second);
    spec.receiver.filter = ReceiverFilter::None;
    spec.receive[0].element_pattern = Pattern::Rectangle {
        length_m: 0.03,
        width_m: 0.0,
        baffled: true,
    };
    // Looks to starboard.
    spec.receive[0].mounting.body_from_array = rotation_from_angles(-1.2, 0.0, 0.0);
    let mut plan = plan(&spec, 1);
    let turn = rotation_from_angles(0.1, -0.05, 0.3);
    plan.trajectory = Trajectory::uniform(
        DVec3::new(500.0, -300.0, 4.0),
        DVec3::new(4.0, 2.5, -0.3),
        turn,
    );
    let mut instrument = made(&spec);
    let towards = DVec3::new(
        0.2f64.cos() * 1.1f64.cos(),
        0.2f64.cos() * 1.1f64.sin(),
        0.2f64.sin(),
    );
    // Pulses at UTC 0 + 0.0123 s + n 0.5 s; the ping is at a whole 0.2 s.
    let arrival_s = 0.5 + 0.0123 - 0.2;
    plan.sample_count = 8000;
    for element in [0, 3] {
        let got = silence(&mut instrument, &plan, 0, element);
        let start_m = plan.trajectory.pose_at(arrival_s).position_m;
        let arm_m = spec.receive[0].element_body_m(element);
        let facing = turn * spec.receive[0].mounting.body_from_array;
        let along = (facing.inverse() * towards).x;
        let x = 0.03 * along / (C / 101.5e3);
        let pattern = (PI * x).sin() / (PI * x);
        // 140 dB - 180 dB.
        let volts = 1e-2 * pattern;
        let (mut heard, mut worst) = (0, 0.0f64);
        for (k, got) in got.iter().enumerate() {
            let t_s = k as f64 / RATE_HZ;
            let place_m = plan.trajectory.pose_at(t_s).point_m(arm_m);
            let wave_s = t_s - arrival_s + towards.dot(place_m - start_m) / C;
            let cycles = 101.5e3 * wave_s - CARRIER_HZ * t_s;
            let want = second.pulse.envelope(wave_s) * waveform::turn(cycles) * volts;
            worst = worst.max((got - want).norm() / volts.abs());
            heard += usize::from(got.norm() > 0.5 * volts.abs());
        }
        println!("element {element}: {heard} samples, worst {worst:.1e}");
        assert!(
            (50..60).contains(&heard) && worst < 1e-6,
            "{element}: {heard} {worst:e}"
        );
    }
    // From behind the baffle nothing arrives.
    spec.receive[0].mounting.body_from_array = rotation_from_angles(1.2, 0.0, 0.0);
    let got = silence(&mut made(&spec), &plan, 0, 0);
    assert!(got.iter().all(|v| *v == Complex64::ZERO));
}

/// Through the receiver filter, at rest: as a sum at 48 points per sample.
#[test]
fn a_second_sonar_passes_the_receiver_filter() {
    let second = second(0.5, 0.0);
    let spec = hearing(second);
    let filter = design(&spec).decimator().expect("fits");
    let mut plan = plan(&spec, 1);
    plan.sample_count = 8000;
    let got = silence(&mut made(&spec), &plan, 0, 1);
    let towards_x = 0.2f64.cos() * 1.1f64.cos();
    let arrival_s = 0.3123 - towards_x * spec.receive[0].along_m(1) / C;
    let first_s = filter.dense_first_s(0.0);
    let dense: Vec<Complex64> = (0..filter.dense_len(plan.sample_count))
        .map(|k| first_s + k as f64 / filter.dense_rate_hz())
        .map(|t_s| {
            let wave_s = t_s - arrival_s;
            let cycles = 101.5e3 * wave_s - CARRIER_HZ * t_s;
            second.pulse.envelope(wave_s) * waveform::turn(cycles) * 1e-2
        })
        .collect();
    let mut want = vec![Complex64::ZERO; plan.sample_count];
    filter.apply(&dense, &mut want);
    let off = got
        .iter()
        .zip(&want)
        .map(|(g, w)| (g - w).norm())
        .fold(0.0, f64::max);
    println!("worst {:.1e}", off / 1e-2);
    assert!(off < 1e-3 * 1e-2, "{off:e}");
    assert!(got.iter().any(|v| v.norm() > 0.9e-2));
}

/// Over pings of 0.2 s, pulses with a period of 0.13 s move through the record by 10 ms each third pulse, and by their drift.
#[test]
fn pulses_of_a_second_sonar_run_across_pings_on_its_own_clock() {
    for (period_s, drift_ppm) in [(0.13, 0.0), (0.13, 250.0), (0.05, -40.0)] {
        let mut spec = hearing(second(period_s, drift_ppm));
        spec.receiver.filter = ReceiverFilter::None;
        let mut instrument = made(&spec);
        let mut arrivals = 0_usize;
        for number in 1..=20 {
            let plan = plan(&spec, number);
            let got = silence(&mut instrument, &plan, 0, 0);
            let heard: Vec<bool> = got.iter().map(|v| v.norm() > 0.0).collect();
            let starts = (1..SAMPLES).filter(|&k| heard[k] && !heard[k - 1]);
            let ahead_s = 0.2f64.cos() * 1.1f64.cos() * spec.receive[0].along_m(0) / C;
            for start in starts {
                // In nanoseconds of UTC, less a whole number of its periods.
                let at_ns = plan.transmit_utc.0 as i128 + (start as f64 / RATE_HZ * 1e9) as i128;
                let period_fs = (period_s * 1e9) as i128 * (1_000_000 + drift_ppm as i128);
                let since_fs = (at_ns - 12_300_000) * 1_000_000;
                let off_s = since_fs.rem_euclid(period_fs) as f64 * 1e-15 + ahead_s;
                // The first sample of a pulse: up to one sample after its start, and 2 more while the flank begins.
                assert!(off_s > -1e-6 && off_s < 3.0 / RATE_HZ, "{number}: {off_s}");
                arrivals += 1;
            }
        }
        let expected = (20.0 * 0.1 / period_s) as usize;
        assert!(arrivals.abs_diff(expected) <= 8, "{arrivals} {expected}");
    }
}

#[test]
fn a_sonar_at_rest_in_a_turned_body_hears_it_from_the_same_place() {
    // The bearing is that of the world: with the body turned by 1.1 rad it lies ahead, along the line of the array.
    let mut spec = hearing(SecondSonar {
        depression_rad: 0.0,
        ..second(0.5, 0.0)
    });
    spec.receiver.filter = ReceiverFilter::None;
    let mut plan = plan(&spec, 1);
    plan.sample_count = 8000;
    plan.trajectory = Trajectory::uniform(
        DVec3::ZERO,
        DVec3::ZERO,
        rotation_from_angles(0.0, 0.0, 1.1),
    );
    let mut instrument = made(&spec);
    let [last, first] = [0, 3].map(|e| silence(&mut instrument, &plan, 0, e));
    // The bow element is 0.15 m nearer: 100 us, two samples. It receives the pulse earlier.
    let phase = Complex64::from_polar(1.0, TAU * CARRIER_HZ * 1e-4);
    for (k, late) in last.iter().enumerate().skip(2) {
        assert!((late * phase - first[k - 2]).norm() < 1e-9, "{k}");
    }
    assert!(last.iter().any(|v| v.norm() > 0.9e-2));
    assert!(plan.trajectory.pose_at(0.0).world_from_body != DQuat::IDENTITY);
}
