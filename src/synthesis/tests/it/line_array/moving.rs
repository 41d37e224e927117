//! Tests of the line-array engine on a moving platform: surge, sway and heave.

use echotank_synthesis::array::gridded2d::{PulseMotion, Resolution};
use glam::DVec3;

use super::still::FINE;
use echotank_testing::line_scene::*;

#[test]
fn in_motion_the_engine_meets_the_direct_sum() {
    // Motion along the array; heave and sway; all together; and far across the array. The remaining error is of
    // third order in the motion.
    for (velocity_m_per_s, sector_deg, limit) in [
        (DVec3::new(5.0, 0.0, 0.0), 60.0, 5e-6),
        (DVec3::new(10.0, 0.0, 0.0), 15.0, 8e-6),
        (DVec3::new(0.0, 0.0, 0.5), 60.0, 4e-6),
        (DVec3::new(0.0, 0.5, 0.0), 15.0, 4e-6),
        (DVec3::new(5.0, 0.3, 0.5), 60.0, 5e-6),
        (DVec3::new(0.0, 5.0, 0.0), 15.0, 5e-5),
    ] {
        let scene = draw(Draw {
            sector_deg,
            velocity_m_per_s,
            scatterers: 120,
            far_m: 60.0,
            ..SIDE_SCAN
        });
        let (got, reports) = error::<f64>(&scene, FINE, false);
        let predicted = reports.iter().map(|r| r.left_out).fold(0.0, f64::max);
        let widest = reports.iter().max_by_key(|r| r.columns);
        println!(
            "{velocity_m_per_s} m/s, +-{sector_deg} deg: {got:.2e}, series {predicted:.1e}; {widest:?}"
        );
        assert!(
            got < limit && got < predicted + 1e-5,
            "{velocity_m_per_s} m/s, +-{sector_deg} deg: {got:e}, predicted {predicted:e}"
        );
    }
}

#[test]
fn in_motion_the_quadratic_engine_meets_the_reference_and_the_linear_does_not() {
    let quadratic = Resolution {
        motion: PulseMotion::Quadratic,
        ..FINE
    };
    for velocity_m_per_s in [DVec3::new(10.0, 0.0, 0.0), DVec3::new(5.0, 0.3, 0.5)] {
        let scene = draw(Draw {
            velocity_m_per_s,
            scatterers: 40,
            far_m: 44.0,
            ..SIDE_SCAN
        });
        let [got, linear] = [quadratic, FINE].map(|resolution| {
            let (records, _) = engine::<f64>(&scene, resolution);
            [0, 31].map(|e| {
                let want = truth(&scene, e, true);
                worst_window(&records[e], &want, scene.plan.pulse.duration_s)
            })
        });
        println!("{velocity_m_per_s} m/s: {got:?}, linear {linear:?}");
        for (got, linear) in got.into_iter().zip(linear) {
            assert!(
                got < 3e-5 && linear > 5e-3,
                "{velocity_m_per_s} m/s: {got:e}, linear {linear:e}"
            );
        }
    }
}
