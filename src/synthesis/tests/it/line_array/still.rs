//! Tests of the line-array engine on a platform at rest.

use std::sync::Mutex;

use echotank_synthesis::array::gridded2d::{PulseMotion, Resolution};
use echotank_synthesis::arrivals::LineSource;
use echotank_synthesis::arrivals::{LineChunk, LineSection, LineSink};
use echotank_synthesis::echo::LineWorkspace;
use glam::DVec3;

use echotank_testing::line_scene::*;

/// Resolution with full accuracy of all stages.
pub(crate) const FINE: Resolution = Resolution {
    section_elements: 16,
    slab_samples: 2048,
    time_width: 12,
    slope_width: 12,
    time_oversampling: 2.0,
    time_core: 1.0,
    slope_oversampling: 2.0,
    moments: 12,
    series: 1e-8,
    far: 1e-9,
    motion: PulseMotion::Stretch,
};

#[test]
fn at_rest_the_engine_meets_the_direct_sum() {
    for (elements, sector_deg) in [(32, 15.0), (32, 60.0), (128, 15.0)] {
        let scene = draw(Draw {
            elements,
            sector_deg,
            ..SIDE_SCAN
        });
        let (got, reports) = error::<f64>(&scene, FINE, false);
        println!(
            "{elements} elements, +-{sector_deg} deg: {got:.2e}; {:?}",
            reports.iter().max_by_key(|r| r.columns)
        );
        assert!(got < 3e-7, "{elements}, +-{sector_deg} deg: {got:e}");
    }
}

#[test]
fn echoes_at_the_ends_of_a_long_section_keep_their_delays() {
    // Near endfire, the ends of the line receive echoes 160 us before and after its middle. Slabs of 20 ms begin and end along the
    // whole record.
    let scene = draw(Draw {
        elements: 128,
        sector_deg: 60.0,
        ..SIDE_SCAN
    });
    let resolution = Resolution {
        section_elements: 128,
        slab_samples: 1024,
        ..FINE
    };
    let (got, reports) = error::<f64>(&scene, resolution, false);
    println!("{} tasks: {got:.2e}", reports.len());
    // Fourth-order delay along half the line, at 36 m: 1e-6 rad.
    assert!(reports.len() > 4 && got < 3e-6, "{got:e}");
}

/// The smallest and largest delay that the sink receives.
struct Delays(f64, f64);

impl LineSink for Delays {
    fn accept(&mut self, chunk: &LineChunk) {
        for &delay_s in &chunk.delay_s[..chunk.len] {
            *self = Self(self.0.min(delay_s), self.1.max(delay_s));
        }
    }
}

#[test]
fn slabs_begin_with_the_first_echo_and_share_the_rest_evenly() {
    for velocity_m_per_s in [DVec3::ZERO, DVec3::new(5.0, 0.3, -0.3)] {
        let mut scene = draw(Draw {
            velocity_m_per_s,
            ..SIDE_SCAN
        });
        // The record begins with the pulse, long before the first echo.
        let before = (scene.plan.first_sample_s * RATE_HZ).round();
        scene.plan.sample_count += before as usize;
        scene.plan.first_sample_s = 0.0;
        let (transmit_leg, _) = scene.transmit_leg();
        let work = [Mutex::new(LineWorkspace::default())];
        let echoes = scene.echoes(&transmit_leg, &work);
        let end_m = scene.rx.along_m(scene.rx.elements - 1);
        let mut delays = Delays(f64::INFINITY, 0.0);
        for middle_m in [-end_m, 0.0, end_m] {
            let section = LineSection {
                middle_m,
                half_m: 0.0,
                gain_terms: false,
                elements: 1,
                earliest_s: 0.0,
                latest_s: 1.0,
            };
            echoes.walk(section, &mut delays);
        }
        let earliest_s = echoes.earliest_s();
        println!("not before {earliest_s} s: from {} s on", delays.0);
        assert!(earliest_s <= delays.0, "{earliest_s} {}", delays.0);
        assert!(delays.0 - earliest_s < 1e-3, "{earliest_s} {}", delays.0);
        let (got, reports) = error::<f64>(&scene, FINE, false);
        let counts: Vec<usize> = reports.iter().map(|report| report.echoes).collect();
        println!("{got:.2e}; echoes of the tasks: {counts:?}");
        let tolerance = if velocity_m_per_s == DVec3::ZERO {
            3e-7
        } else {
            1e-5
        };
        assert!(got < tolerance, "{got:e}");
        // 36 m to 75 m take 52 ms, and a slab at most 34 ms. There are two sections.
        assert_eq!(counts.len(), 4, "{counts:?}");
        assert!(counts.iter().all(|count| *count > 100), "{counts:?}");
    }
}
