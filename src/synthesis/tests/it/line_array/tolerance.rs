//! Tests that the requested tolerance is met in every window.

use echotank_core::simd::SimdLevel;
use echotank_synthesis::array::gridded2d::{
    Bounds, Choice, Precision, Refusal, Resolution, choose,
};
use glam::DVec3;

use echotank_testing::line_scene::*;

fn chosen(scene: &Scene, drawn: Draw, tolerance: f64) -> Result<Choice, Refusal> {
    let bounds = Bounds {
        nearest_m: drawn.near_m,
        greatest_slope: drawn.sector_deg.to_radians().sin(),
        along_m_per_s: drawn.velocity_m_per_s.x.abs(),
        across_m_per_s: drawn.velocity_m_per_s.with_x(0.0).length(),
        turning_rad_per_s: 0.0,
    };
    choose(&scene.spec(bounds, tolerance))
}

#[test]
fn the_error_by_window_keeps_every_tolerance() {
    let mut cells = 0;
    for velocity_m_per_s in [
        DVec3::ZERO,
        DVec3::new(10.0, 0.0, 0.0),
        DVec3::new(5.0, 0.3, 0.3),
    ] {
        for sector_deg in [15.0, 60.0] {
            let drawn = Draw {
                elements: 64,
                scatterers: 120,
                velocity_m_per_s,
                sector_deg,
                far_m: 60.0,
                ..SIDE_SCAN
            };
            let scene = draw(drawn);
            let truth = Truth::of(&scene, false);
            for tolerance in [1e-1, 1e-2, 1e-3, 1e-4, 2e-5] {
                let choice = match chosen(&scene, drawn, tolerance) {
                    Ok(choice) => choice,
                    Err(refusal) => {
                        println!("{velocity_m_per_s} m/s, +-{sector_deg} deg: {refusal}");
                        continue;
                    }
                };
                cells += 1;
                let (got, reports) = match choice.precision {
                    Precision::Single => truth.error::<f32>(&scene, choice.resolution),
                    Precision::Double => truth.error::<f64>(&scene, choice.resolution),
                };
                let left_out = reports.iter().map(|r| r.left_out).fold(0.0, f64::max);
                let most = reports.iter().max_by_key(|r| r.channels).expect("tasks");
                println!(
                    "{velocity_m_per_s} m/s, +-{sector_deg} deg, {tolerance:e}: {got:.1e}, predicted {:.1e}, left out {left_out:.1e}; section {}, width {}, {} columns, {} channels, {:?}",
                    choice.error_model.error,
                    choice.resolution.section_elements,
                    choice.resolution.time_width,
                    most.columns,
                    most.channels,
                    most.orders,
                );
                assert!(
                    got <= tolerance && got <= 1.1 * choice.error_model.error.max(left_out),
                    "{got:e} against {tolerance:e}: {}",
                    choice.error_model.why
                );
            }
        }
    }
    assert!(cells >= 27, "only {cells} cells were computed");
}

#[test]
fn unreachable_tolerances_are_refused_with_a_reason() {
    let scene = draw(SIDE_SCAN);
    let fine = chosen(&scene, SIDE_SCAN, 1e-7).expect_err("too fine");
    assert!(matches!(fine, Refusal::TooFine { .. }), "{fine}");
    assert!(fine.to_string().contains("below its minimum"), "{fine}");
    // A section of one element has no curvature. Close to a wall, no longer section meets the
    // tolerance.
    let close = Draw {
        near_m: 0.5,
        ..SIDE_SCAN
    };
    match chosen(&scene, close, 1e-3) {
        Ok(choice) => assert!(
            choice.resolution.section_elements < 64,
            "{:?}",
            choice.resolution
        ),
        Err(refusal) => assert!(matches!(refusal, Refusal::TooNear { .. }), "{refusal}"),
    }
    assert!(chosen(&scene, SIDE_SCAN, f64::NAN).is_err());
}

#[test]
fn simd_levels_agree_to_rounding_and_task_orders_bit_for_bit() {
    let drawn = Draw {
        scatterers: 200,
        velocity_m_per_s: DVec3::new(5.0, 0.3, 0.3),
        far_m: 60.0,
        ..SIDE_SCAN
    };
    let scene = draw(drawn);
    let resolution = chosen(&scene, drawn, 1e-3).expect("easy").resolution;
    let plain = engine_in::<f32>(&scene, resolution, SimdLevel::PORTABLE, false).0;
    for simd_level in SimdLevel::available() {
        let forward = engine_in::<f32>(&scene, resolution, simd_level, false).0;
        let backward = engine_in::<f32>(&scene, resolution, simd_level, true).0;
        assert!(
            forward == backward,
            "{simd_level:?}: the order of the tasks shows"
        );
        for (e, (got, want)) in forward.iter().zip(&plain).enumerate() {
            let worst = worst_window(got, want, scene.plan.pulse.duration_s);
            assert!(worst < 2e-6, "{simd_level:?}, element {e}: {worst:e}");
        }
    }
    // Kernels over time with other widths. Some widths have specialised code.
    for time_width in [3, 4, 6, 7, 8, 9] {
        let resolution = Resolution {
            time_width,
            ..resolution
        };
        let plain = engine_in::<f32>(&scene, resolution, SimdLevel::PORTABLE, false).0;
        let best = engine_in::<f32>(&scene, resolution, SimdLevel::best(), false).0;
        for (e, (got, want)) in best.iter().zip(&plain).enumerate() {
            let worst = worst_window(got, want, scene.plan.pulse.duration_s);
            assert!(worst < 2e-6, "{time_width} rows, element {e}: {worst:e}");
        }
    }
}
