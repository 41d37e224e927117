//! Tests of the engine for whole line arrays against the direct sum.

use echotank_core::arrays::{ArrayGeometry, Pattern};
use echotank_core::model::DopplerModel;
use echotank_core::simd::SimdLevel;
use echotank_synthesis::array::gridded::{LEVELS, level_of};
use echotank_synthesis::array::lines::{Design, GriddedLines, Heard, LineMotion, Refusal, Spec};
use echotank_synthesis::echo::walk::{NodeBatch, NodeTracks, NodeWorkspace};
use glam::DVec3;
use num_complex::Complex64;

use echotank_testing::line_scene::*;

const SCENE: Draw = Draw {
    elements: 40,
    scatterers: 1200,
    sector_deg: 50.0,
    far_m: 50.0,
    ..SIDE_SCAN
};

/// Scene with a short pulse, as used by multibeam echo sounders, instead of the side-scan chirp of 5 ms.
fn short(drawn: Draw, duration_s: f64, bandwidth_hz: f64) -> Scene {
    let mut scene = draw(drawn);
    let pulse = &mut scene.plan.pulse;
    pulse.duration_s = duration_s;
    pulse.bandwidth_hz = bandwidth_hz;
    let speed = drawn.velocity_m_per_s.length().max(1.0);
    let doppler_hz = 2.1 * speed / echotank_testing::echo::C * echotank_testing::echo::CARRIER_HZ;
    scene.decimator =
        echotank_synthesis::array::Decimator::new(pulse, RATE_HZ, doppler_hz, 32).expect("fits");
    scene
}

fn made(scene: &Scene, tolerance: f64, simd_level: SimdLevel) -> Result<GriddedLines, Refusal> {
    GriddedLines::new(&Spec {
        simd_level,
        ..spec(scene, &scene.rx, tolerance)
    })
}

fn spec<'a>(scene: &'a Scene, array: &'a ArrayGeometry, tolerance: f64) -> Spec<'a> {
    Spec {
        array,
        pulse: &scene.plan.pulse,
        sound_speed_m_per_s: echotank_testing::echo::C,
        sample_rate_hz: RATE_HZ,
        filter: Some(&scene.decimator),
        doppler: scene.plan.model.doppler,
        nearest_m: 10.0,
        fastest_m_per_s: 10.0,
        tolerance,
        samples: scene.plan.sample_count,
        scatterers: scene.scatterers.len(),
        min_scatterers: scene.scatterers.len(),
        simd_level: SimdLevel::best(),
    }
}

fn samples(scene: &Scene, engine: &mut GriddedLines) -> Vec<Complex64> {
    let (leg, _) = scene.transmit_leg();
    let mut iq = vec![Complex64::ONE; scene.rx.elements * scene.plan.sample_count];
    let counts = engine.synthesise(&scene.plan, &leg, &mut iq);
    let pairs = (scene.scatterers.len() * scene.rx.elements) as u64;
    assert_eq!(counts.used + counts.outside_window + counts.culled, pairs);
    assert!(counts.used > pairs / 2, "{counts:?}");
    assert_eq!(counts.beyond_engine, 0);
    iq
}

/// Elements keep the tolerance. `iq`: samples of all elements; `case`: to print.
fn assert_kept(
    (scene, iq): (&Scene, &[Complex64]),
    elements: impl IntoIterator<Item = usize>,
    (tolerance, pulse_s): (f64, f64),
    case: &str,
) {
    let count = scene.plan.sample_count;
    for element in elements {
        let want = truth(scene, element, false);
        let error = worst(&iq[element * count..][..count], &want, pulse_s);
        println!("{case}, element {element}: asked {tolerance:.0e}, delivered {error:.1e}");
        assert!(error <= tolerance, "{case}, element {element}: {error:e}");
    }
}

/// Largest error of any window of one pulse length. It is relative to the level of the window or to a noise 55 dB below the
/// strongest, whichever is larger.
fn worst(got: &[Complex64], want: &[Complex64], pulse_s: f64) -> f64 {
    worst_by_level(got, want, pulse_s)
        .into_iter()
        .fold(0.0, f64::max)
}

/// The same in windows whose levels below the strongest are those of [`level_of`].
fn worst_by_level(got: &[Complex64], want: &[Complex64], pulse_s: f64) -> [f64; LEVELS] {
    let length = ((pulse_s * RATE_HZ) as usize).max(32);
    let energy = |x: &mut dyn Iterator<Item = Complex64>| x.map(|v| v.norm_sqr()).sum::<f64>();
    let windows = want.windows(length).zip(got.windows(length));
    let parts: Vec<(f64, f64)> = windows
        .map(|(want, got)| {
            (
                energy(&mut want.iter().copied()),
                energy(&mut want.iter().zip(got).map(|(a, b)| a - b)),
            )
        })
        .collect();
    let strongest = parts.iter().map(|part| part.0).fold(0.0, f64::max);
    let floor = strongest * 10f64.powf(-5.5);
    let mut worst = [0.0f64; LEVELS];
    for (level, error) in parts {
        let of_level = &mut worst[level_of(level / strongest)];
        *of_level = of_level.max((error / level.max(floor)).sqrt());
    }
    worst
}

#[test]
fn every_window_keeps_its_tolerance_and_is_not_much_better() {
    let still = DVec3::ZERO;
    let mut ratios = Vec::new();
    for (scatterers, velocity_m_per_s, duration_s, bandwidth_hz) in [
        (1200, still, 0.4e-3, 0.0),
        (1200, DVec3::new(0.3, 5.0, 0.3), 0.4e-3, 0.0),
        (40_000, DVec3::new(0.3, 5.0, 0.3), 0.4e-3, 0.0),
        (40, DVec3::new(0.3, 5.0, 0.3), 0.4e-3, 0.0),
        (1200, DVec3::new(5.0, 0.3, 0.3), 0.3e-3, 0.0),
        (1200, DVec3::new(5.0, 0.3, -0.3), 1e-3, 30e3),
        (1200, DVec3::new(5.0, 0.3, -0.3), 5e-3, 30e3),
    ] {
        let drawn = Draw {
            velocity_m_per_s,
            scatterers,
            ..SCENE
        };
        let scene = short(drawn, duration_s, bandwidth_hz);
        let elements = [0, 13, 39];
        let truths = elements.map(|element| truth(&scene, element, false));
        let mut cost_ms = f64::INFINITY;
        for tolerance in [3e-4, 5e-4, 1e-3, 1e-2, 1e-1] {
            let mut engine = made(&scene, tolerance, SimdLevel::best()).expect("within reach");
            let iq = samples(&scene, &mut engine);
            let errors = elements.iter().zip(&truths).map(|(&element, want)| {
                let count = scene.plan.sample_count;
                worst(&iq[element * count..][..count], want, duration_s)
            });
            let error = errors.fold(0.0, f64::max);
            println!(
                "{scatterers} echoes, {velocity_m_per_s} m/s, {duration_s} s: asked {tolerance:.0e}, delivered {error:.1e}; {}",
                engine.error_model().why
            );
            assert!(error <= tolerance, "{error:e} of {tolerance:e}");
            assert!(engine.error_model().cost_ms <= cost_ms);
            cost_ms = engine.error_model().cost_ms;
            ratios.push(tolerance / error);
        }
    }
    ratios.sort_by(f64::total_cmp);
    assert!(ratios[ratios.len() / 2] <= 5.0, "{ratios:?}");
}

/// The last block of 40 elements has 8, that of 20 has 4.
#[test]
fn threads_do_not_change_a_bit_and_simd_levels_little() {
    for elements in [40, 20] {
        let drawn = Draw {
            elements,
            velocity_m_per_s: DVec3::new(3.0, 0.3, 0.3),
            ..SCENE
        };
        let scene = short(drawn, 0.4e-3, 0.0);
        let by = |threads: usize, simd_level: SimdLevel| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
            pool.expect("threads").install(|| {
                let mut engine = made(&scene, 1e-3, simd_level).expect("within reach");
                let first = samples(&scene, &mut engine);
                assert!(
                    first == samples(&scene, &mut engine),
                    "the second ping differs"
                );
                first
            })
        };
        let one = by(1, SimdLevel::best());
        for threads in [2, 8] {
            assert!(by(threads, SimdLevel::best()) == one, "{threads} threads");
        }
        let scale = one.iter().map(|v| v.norm()).fold(0.0, f64::max);
        for simd_level in SimdLevel::available() {
            let other = by(1, simd_level);
            let off = one.iter().zip(&other).map(|(a, b)| (a - b).norm());
            let off = off.fold(0.0, f64::max) / scale;
            println!("{elements} elements, {simd_level:?}: {off:.1e}");
            assert!(off < 1e-5, "{simd_level:?}: {off:e}");
        }
    }
}

/// Every kind of last block, against the direct sum at its first and last element.
#[test]
fn lines_of_any_number_of_elements_keep_the_tolerance() {
    for elements in [2, 4, 5, 8, 9, 16, 17, 20, 21, 35] {
        let drawn = Draw {
            elements,
            velocity_m_per_s: DVec3::new(5.0, 0.3, 0.3),
            ..SCENE
        };
        let scene = short(drawn, 0.4e-3, 0.0);
        let tolerance = 1e-3;
        let mut engine = made(&scene, tolerance, SimdLevel::best()).expect("within reach");
        let iq = samples(&scene, &mut engine);
        let last = [(elements - 1) / 16 * 16, elements - 1];
        let case = format!("{elements} elements");
        assert_kept((&scene, &iq), last, (tolerance, 0.4e-3), &case);
    }
}

/// The patterns of elements as long as those of side-scans change along the line; near the array no number of nodes follows them.
#[test]
fn lines_of_long_elements_keep_the_tolerance_from_a_range_on() {
    let drawn = Draw {
        elements: 20,
        velocity_m_per_s: DVec3::new(5.0, 0.3, 0.3),
        ..SCENE
    };
    let mut scene = short(drawn, 0.4e-3, 0.0);
    scene.rx.spacing_m = 0.05;
    scene.rx.element_pattern = Pattern::Rectangle {
        length_m: 0.05,
        width_m: 0.003,
        baffled: false,
    };
    let tolerance = 5e-3;
    let mut engine = made(&scene, tolerance, SimdLevel::best()).expect("within reach");
    let iq = samples(&scene, &mut engine);
    assert_kept(
        (&scene, &iq),
        [0, 7, 19],
        (tolerance, 0.4e-3),
        "long elements",
    );
    let design = Design::new(&spec(&scene, &scene.rx, tolerance)).expect("within reach");
    assert!(design.nodes(&scene.rx, 36.0).is_some());
    assert_eq!(design.nodes(&scene.rx, 5.0), None);
}

/// 20 elements of 25 mm some 5 m above a bottom: an engine for such scatterers leaves more of the tolerance to the interpolation, and keeps it. One for
/// scatterers 50 m away leaves the near ones to the direct sum.
#[test]
fn an_engine_for_near_scatterers_interpolates_them() {
    let drawn = Draw {
        elements: 20,
        velocity_m_per_s: DVec3::new(1.0, 0.3, 0.3),
        ..SCENE
    };
    let mut scene = short(drawn, 0.4e-3, 0.0);
    let earlier_s = 0.5 * scene.plan.first_sample_s;
    scene.plan.first_sample_s -= earlier_s;
    scene.plan.sample_count += (earlier_s * RATE_HZ) as usize;
    scene.rx.spacing_m = 0.025;
    scene.rx.mounting.position_m = scene.scatterers.position_m(0) - DVec3::new(0.0, 0.0, 5.3);
    let tolerance = 5e-3;
    let (leg, _) = scene.transmit_leg();
    let count = scene.plan.sample_count;
    let mut iq = vec![Complex64::ONE; scene.rx.elements * count];
    let beyond = |nearest_m: f64, iq: &mut [Complex64]| {
        let mut engine = GriddedLines::new(&Spec {
            nearest_m,
            ..spec(&scene, &scene.rx, tolerance)
        })
        .expect("within reach");
        engine.synthesise(&scene.plan, &leg, iq).beyond_engine
    };
    assert!(beyond(50.0, &mut iq) > 0);
    assert_eq!(beyond(5.0, &mut iq), 0);
    assert_kept((&scene, &iq), [0, 9, 19], (tolerance, 0.4e-3), "near");
}

/// Nodes are chosen by the distance from the array, which may lie far from the transmitter.
#[test]
fn scatterers_near_the_array_and_far_from_the_transmitter_keep_the_tolerance() {
    let drawn = Draw {
        velocity_m_per_s: DVec3::new(1.0, 0.3, 0.3),
        ..SCENE
    };
    let mut scene = short(drawn, 0.4e-3, 0.0);
    // Its echo arrives long before the others.
    let earlier_s = 0.5 * scene.plan.first_sample_s;
    scene.plan.first_sample_s -= earlier_s;
    scene.plan.sample_count += (earlier_s * RATE_HZ) as usize;
    scene.rx.mounting.position_m = scene.scatterers.position_m(0) - DVec3::new(0.3, 0.0, 0.3);
    let tolerance = 2e-3;
    let mut engine = made(&scene, tolerance, SimdLevel::best()).expect("within reach");
    let (leg, _) = scene.transmit_leg();
    let count = scene.plan.sample_count;
    let mut iq = vec![Complex64::ONE; scene.rx.elements * count];
    let counts = engine.synthesise(&scene.plan, &leg, &mut iq);
    assert_eq!(counts.beyond_engine, 0);
    assert_kept(
        (&scene, &iq),
        [0, 9, 39],
        (tolerance, 0.4e-3),
        "near the array",
    );
}

/// The errors of a single moving echo: in windows of each level, and rms over its places on the grid, which differ from element to element.
#[test]
fn a_single_echo_has_its_predicted_errors() {
    for (velocity_m_per_s, duration_s, bandwidth_hz, tolerance) in [
        (DVec3::new(0.3, 5.0, 0.3), 0.4e-3, 0.0, 1e-2),
        (DVec3::new(5.0, 0.3, -0.3), 1e-3, 30e3, 1e-3),
        (DVec3::new(5.0, 0.3, -0.3), 5e-3, 30e3, 3e-2),
    ] {
        let (mut largest, mut off, mut level) = ([0.0f64; LEVELS], 0.0, 0.0);
        let mut predicted = (0.0, [0.0; LEVELS]);
        for seed in 0..8 {
            let scene = short(
                Draw {
                    velocity_m_per_s,
                    scatterers: 1,
                    seed,
                    ..SCENE
                },
                duration_s,
                bandwidth_hz,
            );
            let spec = spec(&scene, &scene.rx, tolerance);
            let design = Design::new(&spec).expect("within reach");
            let motion = LineMotion {
                range_m: (SCENE.near_m, SCENE.far_m),
                closing_m_per_s: velocity_m_per_s.length(),
                curvature_per_s: velocity_m_per_s.length_squared()
                    / (SCENE.near_m * spec.sound_speed_m_per_s),
            };
            predicted = design.echo_errors(&scene.rx, motion);
            let mut engine = GriddedLines::of_design(&spec, design).expect("as above");
            let iq = samples(&scene, &mut engine);
            for element in [0, 9, 21, 39] {
                let count = scene.plan.sample_count;
                let (got, want) = (
                    &iq[element * count..][..count],
                    truth(&scene, element, false),
                );
                let errors = worst_by_level(got, &want, duration_s);
                for (largest, error) in largest.iter_mut().zip(errors) {
                    *largest = largest.max(error);
                }
                off += got
                    .iter()
                    .zip(&want)
                    .map(|(a, b)| (a - b).norm_sqr())
                    .sum::<f64>();
                level += want.iter().map(|x| x.norm_sqr()).sum::<f64>();
            }
        }
        let (rms, by_level) = predicted;
        let measured = (off / level).sqrt();
        println!(
            "{velocity_m_per_s} m/s, {duration_s} s: rms {measured:.1e} of {rms:.1e}; by level"
        );
        assert!(measured <= rms && rms < 4.0 * measured, "{measured} {rms}");
        // As the margin of the selection.
        for (largest, predicted) in largest.into_iter().zip(by_level) {
            println!("{largest:.1e} of {predicted:.1e}");
            assert!(largest <= 1.4 * predicted, "{largest} {predicted}");
        }
        let of_worst = |errors: [f64; LEVELS]| errors.into_iter().fold(0.0, f64::max);
        let (largest, predicted) = (of_worst(largest), of_worst(by_level));
        assert!(predicted < 1.5 * largest, "{largest} {predicted}");
    }
}

/// Echoes that are fewer, sound for a shorter time or close at more equal speeds need fewer slabs and columns.
#[test]
fn a_ping_costs_what_its_echoes_need() {
    let mut scene = short(SCENE, 8e-3, 30e3);
    scene.plan.model.doppler = DopplerModel::Stretch;
    let mut spec = spec(&scene, &scene.rx, 1e-2);
    spec.samples = 20_000;
    let design = Design::new(&spec).expect("within reach");
    let all = Heard {
        echoes: 10_000.0,
        differ_m_per_s: 4.0,
        duration_s: 1.0,
    };
    let record_s = spec.samples as f64 / spec.sample_rate_hz;
    let ms = |heard| design.cost_estimate(heard).ms();
    let costs = [
        all,
        Heard {
            duration_s: record_s / 3.0,
            ..all
        },
        Heard {
            differ_m_per_s: 1.0,
            ..all
        },
        Heard { echoes: 1.0, ..all },
    ]
    .map(ms);
    println!("{costs:.2?} ms");
    let [all, shorter, closer, one] = costs;
    assert!(shorter < 0.9 * all && closer < 0.9 * all, "{costs:?}");
    assert!(one < shorter.min(closer), "{costs:?}");
}

/// The Doppler changes with the square of the speed over the range.
#[test]
fn echoes_whose_doppler_changes_too_much_are_counted() {
    let counts = |speed_m_per_s: f64| {
        let drawn = Draw {
            velocity_m_per_s: DVec3::new(speed_m_per_s, 0.0, 0.0),
            ..SCENE
        };
        let mut scene = short(drawn, 8e-3, 30e3);
        scene.plan.model.doppler = DopplerModel::StretchQuadratic;
        let mut engine = made(&scene, 5e-4, SimdLevel::best()).expect("within reach");
        let (leg, _) = scene.transmit_leg();
        let mut iq = vec![Complex64::ZERO; scene.rx.elements * scene.plan.sample_count];
        engine.synthesise(&scene.plan, &leg, &mut iq).beyond_engine
    };
    assert_eq!(counts(1.0), 0);
    assert!(counts(9.0) > 0);
}

/// The frequency at the ends of a sweep is not that of the carrier: Dopplers, and their changes during the pulse, turn both ends by different phases.
#[test]
fn sweeps_of_any_relative_bandwidth_keep_the_tolerance_until_echoes_are_counted() {
    use echotank_core::pulse::PulseKind::{Cw, LfmDown, LfmUp};
    let mut kept = 0;
    for (kind, carrier_hz, bandwidth_hz, duration_s, taper) in [
        (LfmUp, 36e3, 27e3, 10e-3, 0.5),
        (LfmUp, 36e3, 27e3, 10e-3, 0.0),
        (LfmUp, 36e3, 27e3, 3e-3, 0.0),
        (LfmDown, 60e3, 30e3, 10e-3, 0.1),
        (LfmUp, 100e3, 10e3, 8e-3, 0.0),
        (Cw, 100e3, 0.0, 0.5e-3, 0.0),
        (LfmDown, 400e3, 30e3, 5e-3, 0.0),
        (Cw, 36e3, 0.0, 10e-3, 0.0),
        (Cw, 200e3, 0.0, 5e-3, 0.5),
    ] {
        for (doppler, speed_m_per_s) in [
            (DopplerModel::Stretch, 10.0),
            (DopplerModel::StretchQuadratic, 2.0),
            (DopplerModel::StretchQuadratic, 4.0),
            (DopplerModel::StretchQuadratic, 6.0),
            (DopplerModel::StretchQuadratic, 10.0),
        ] {
            let drawn = Draw {
                velocity_m_per_s: DVec3::new(speed_m_per_s, 0.0, 0.0),
                scatterers: 12,
                elements: 20,
                taper,
                ..SCENE
            };
            let mut scene = draw(drawn);
            scene.plan.pulse.kind = kind;
            scene.plan.pulse.center_frequency_hz = carrier_hz;
            scene.plan.pulse.bandwidth_hz = bandwidth_hz;
            scene.plan.pulse.duration_s = duration_s;
            scene.plan.model.doppler = doppler;
            let doppler_hz = 2.1 * speed_m_per_s / echotank_testing::echo::C * carrier_hz;
            let pulse = &scene.plan.pulse;
            let decimator =
                echotank_synthesis::array::Decimator::new(pulse, RATE_HZ, doppler_hz, 32);
            scene.decimator = decimator.expect("fits");
            for tolerance in [3e-4, 5e-4, 5e-3] {
                let mut engine = match made(&scene, tolerance, SimdLevel::best()) {
                    Ok(engine) => engine,
                    // Short pulses with sharp ends have much beside their band. What the refusal names is within reach.
                    Err(Refusal::TooFine { least, .. }) => {
                        println!("{kind:?} {carrier_hz} Hz: {least:e} at least");
                        assert!(duration_s < 1e-3 && least > tolerance && least <= 5e-4);
                        assert!(made(&scene, least, SimdLevel::best()).is_ok());
                        continue;
                    }
                    Err(refusal) => panic!("{refusal}"),
                };
                let (leg, _) = scene.transmit_leg();
                let count = scene.plan.sample_count;
                let mut iq = vec![Complex64::ZERO; scene.rx.elements * count];
                let counts = engine.synthesise(&scene.plan, &leg, &mut iq);
                let errors = [0, 11, 19].map(|element| {
                    let want = truth(&scene, element, false);
                    worst(&iq[element * count..][..count], &want, duration_s)
                });
                let error = errors.into_iter().fold(0.0, f64::max);
                println!(
                    "{kind:?} {carrier_hz} Hz, {bandwidth_hz} Hz, {duration_s} s, taper {taper}, {doppler:?}, {speed_m_per_s} m/s: asked {tolerance:.0e}, delivered {error:.1e}, {} beyond; {}",
                    counts.beyond_engine,
                    engine.error_model().why
                );
                if counts.beyond_engine == 0 {
                    assert!(error <= tolerance, "{error:e} of {tolerance:e}");
                    kept += 1;
                }
            }
        }
    }
    println!("{kept} within the design");
    assert!(kept >= 100, "{kept}");
}

/// Along 16 elements the direction of an echo changes, and with it the Doppler: not only in proportion to the place.
#[test]
fn dopplers_that_change_along_a_block_keep_the_tolerance() {
    for (speed_m_per_s, tolerance) in [(1.0, 3e-4), (9.0, 5e-4), (9.0, 2e-3), (9.0, 1e-2)] {
        let drawn = Draw {
            velocity_m_per_s: DVec3::new(speed_m_per_s, 0.3, 0.3),
            scatterers: 60,
            elements: 34,
            ..SCENE
        };
        let mut scene = draw(drawn);
        scene.rx.spacing_m = 0.05;
        let pulse = &mut scene.plan.pulse;
        *pulse = echotank_core::pulse::Pulse {
            kind: echotank_core::pulse::PulseKind::Cw,
            center_frequency_hz: 44e3,
            bandwidth_hz: 0.0,
            duration_s: 10e-3,
            ..*pulse
        };
        let doppler_hz = 2.1 * speed_m_per_s / echotank_testing::echo::C * 44e3;
        let decimator = echotank_synthesis::array::Decimator::new(pulse, RATE_HZ, doppler_hz, 32);
        scene.decimator = decimator.expect("fits");
        let mut engine = made(&scene, tolerance, SimdLevel::best()).expect("within reach");
        let iq = samples(&scene, &mut engine);
        let case = format!("{speed_m_per_s} m/s");
        assert_kept((&scene, &iq), [0, 7, 15, 16, 33], (tolerance, 10e-3), &case);
    }
}

#[test]
fn what_the_engine_cannot_keep_is_refused() {
    let scene = short(SCENE, 0.4e-3, 0.0);
    let refused = |scene: &Scene, tolerance| made(scene, tolerance, SimdLevel::best()).err();
    assert!(matches!(
        refused(&scene, 1e-4),
        Some(Refusal::TooFine { .. })
    ));
    let mut one = short(SCENE, 0.4e-3, 0.0);
    one.rx.elements = 1;
    assert_eq!(refused(&one, 1e-2), Some(Refusal::OneElement));
}

/// Between three nodes the squares of receive legs are interpolated, which leaves the part of the error of delays that motion makes.
#[test]
fn squares_of_receive_legs_are_quadratic_along_the_line_but_for_motion() {
    let velocity_m_per_s = DVec3::new(8.0, 3.0, 1.0);
    let scene = short(
        Draw {
            velocity_m_per_s,
            ..SCENE
        },
        5e-3,
        30e3,
    );
    let (leg, _) = scene.transmit_leg();
    let mach = velocity_m_per_s.length() / echotank_testing::echo::C;
    for (nodes, gains) in [(5, 3), (5, 5), (7, 3), (9, 5)] {
        let along_m: Vec<f64> = (0..nodes)
            .map(|k| 0.5 * (2.0 * k as f64 / (nodes - 1) as f64 - 1.0))
            .collect();
        let from_m = |coarse_from_m: f64| {
            let mut tracks = NodeTracks::default();
            let (plan, rx) = (&scene.plan, &scene.rx);
            tracks.measure(plan, rx, &leg, f64::INFINITY);
            tracks.compute(plan, rx, &leg, &along_m, gains, coarse_from_m);
            tracks
        };
        let tracks = [from_m(f64::INFINITY), from_m(0.0)];
        let mut work = NodeWorkspace::default();
        let [mut fine, mut coarse] = [(); 2].map(|()| Box::<NodeBatch>::default());
        let (mut left, mut plain, mut stretch) = (0.0f64, 0.0f64, 0.0f64);
        for b in 0..NodeTracks::batches(&leg) {
            for (tracks, out) in tracks.iter().zip([&mut fine, &mut coarse]) {
                tracks.batch(&scene.plan, &scene.rx, &leg, b, &mut work, out);
            }
            assert_eq!((fine.len, fine.keep), (coarse.len, coarse.keep));
            for i in 0..fine.len {
                let at = |node: usize| fine.middle_s[node][i];
                let middle = nodes / 2;
                for (node, along_m) in along_m.iter().enumerate() {
                    let x = 2.0 * along_m;
                    let quadratic = at(middle)
                        + 0.5 * x * (at(nodes - 1) - at(0))
                        + 0.5 * x * x * (at(nodes - 1) + at(0) - 2.0 * at(middle));
                    plain = plain.max((quadratic - at(node)).abs());
                    left = left.max((coarse.middle_s[node][i] - at(node)).abs());
                }
                for k in 0..gains {
                    stretch = stretch.max((coarse.doppler[k][i] - fine.doppler[k][i]).abs());
                }
            }
        }
        println!(
            "{nodes} nodes: {left:.1e} s left of {plain:.1e} s, {:.1e}",
            left / plain
        );
        assert!(left < (0.02 + 4.0 * mach) * plain && left > 0.0);
        assert!(stretch < 1e-3 * mach, "{stretch:e}");
    }
}

/// Four elements of 27 wavelengths each, at 33 to 40 m: their ends hear what the middle has near a zero of its pattern.
#[test]
fn an_echo_is_culled_where_no_node_hears_it() {
    let drawn = Draw {
        elements: 4,
        scatterers: 4000,
        sector_deg: 10.0,
        near_m: 33.0,
        far_m: 40.0,
        ..SCENE
    };
    let mut scene = short(drawn, 0.4e-3, 20e3);
    scene.tx.pattern = Pattern::Omnidirectional;
    scene.rx.spacing_m = 0.1;
    let pattern = Pattern::Rectangle {
        length_m: 0.1,
        width_m: 0.0,
        baffled: false,
    };
    let along_m: [f64; 5] = std::array::from_fn(|k| 0.075 * (k as f64 - 2.0));
    let mut keeps = |cull_db: Option<f64>, pattern: Pattern| {
        scene.plan.model.cull_db = cull_db;
        scene.rx.element_pattern = pattern;
        let (leg, _) = scene.transmit_leg();
        let mut tracks = NodeTracks::default();
        tracks.measure(&scene.plan, &scene.rx, &leg, f64::INFINITY);
        tracks.compute(&scene.plan, &scene.rx, &leg, &along_m, 5, f64::INFINITY);
        let (mut work, mut out) = (NodeWorkspace::default(), Box::<NodeBatch>::default());
        let mut all: Vec<(bool, [f64; 5])> = Vec::new();
        for b in 0..NodeTracks::batches(&leg) {
            tracks.batch(&scene.plan, &scene.rx, &leg, b, &mut work, &mut out);
            all.extend(
                (0..out.len).map(|i| (out.keep[i], std::array::from_fn(|k| out.gain[k][i]))),
            );
        }
        all
    };
    const FLOOR: f64 = 0.1;
    let culled = keeps(Some(-20.0), pattern);
    let plain = keeps(None, Pattern::Omnidirectional);
    let mut at_ends_alone = 0;
    for ((keep, gains), (_, plain)) in culled.iter().zip(&plain) {
        let level = |k: usize| (gains[k] / plain[k]).abs();
        let most = (0..5).map(level).fold(0.0, f64::max);
        if (most / FLOOR - 1.0).abs() > 1e-6 {
            assert_eq!(*keep, most > FLOOR, "{most}");
        }
        at_ends_alone += u32::from(*keep && level(2) < 0.8 * FLOOR);
    }
    assert!(at_ends_alone > 50, "{at_ends_alone}");
}

/// 160 elements on arcs of 57 to 150 degrees.
#[test]
fn arcs_keep_their_tolerance_in_every_window() {
    for (half_turn, element_m) in [(0.5, 0.0), (1.3, 0.0), (0.5, 1.8e-3), (1.05, 1.8e-3)] {
        let drawn = Draw {
            elements: 160,
            sector_deg: 65.0,
            velocity_m_per_s: DVec3::new(4.0, 0.5, 0.3),
            ..SCENE
        };
        let mut scene = short(drawn, 0.4e-3, 20e3);
        let half_m = scene.rx.along_m(scene.rx.elements - 1);
        scene.rx.radius_m = Some(half_m / half_turn);
        scene.rx.mounting.body_from_array = echotank_testing::echo::starboard();
        if element_m > 0.0 {
            scene.rx.element_pattern = Pattern::Rectangle {
                length_m: element_m,
                width_m: 0.0,
                baffled: false,
            };
        }
        let elements = [0, 63, 80, 159];
        let truths = elements.map(|element| truth(&scene, element, false));
        for tolerance in [1e-3, 1e-2] {
            let mut engine = match made(&scene, tolerance, SimdLevel::best()) {
                Ok(engine) => engine,
                Err(refusal) => panic!("{half_turn} rad, {tolerance:e}: {refusal}"),
            };
            let (leg, _) = scene.transmit_leg();
            let count = scene.plan.sample_count;
            let mut iq = vec![Complex64::ONE; scene.rx.elements * count];
            let counts = engine.synthesise(&scene.plan, &leg, &mut iq);
            let error = elements.iter().zip(&truths).map(|(&element, want)| {
                worst(
                    &iq[element * count..][..count],
                    want,
                    scene.plan.pulse.duration_s,
                )
            });
            let error = error.fold(0.0, f64::max);
            let design = Design::new(&spec(&scene, &scene.rx, tolerance)).expect("as before");
            let nodes = design.nodes(&scene.rx, 10.0);
            println!(
                "{half_turn} rad, {element_m} m: asked {tolerance:.0e}, delivered {error:.1e}, {nodes:?} nodes"
            );
            // Where no number of nodes is enough, every echo is counted.
            match nodes {
                Some(_) => assert!(error <= tolerance && counts.beyond_engine == 0),
                None => assert!(counts.beyond_engine == counts.used),
            }
            assert!(nodes.is_some() || (half_turn > 1.0 && tolerance < 1e-2));
        }
    }
}

#[test]
fn baffled_elements_on_an_arc_are_refused() {
    let mut scene = draw(SCENE);
    scene.rx.radius_m = Some(0.2);
    let made_of = |scene: &Scene| Design::exists(&spec(scene, &scene.rx, 1e-2)).err();
    assert_eq!(made_of(&scene), None);
    scene.rx.element_pattern = Pattern::Rectangle {
        length_m: 1e-3,
        width_m: 0.0,
        baffled: true,
    };
    assert_eq!(made_of(&scene), Some(Refusal::BaffledArc));
}
