//! Test that the gridded engine does not allocate after its plans and workspaces exist.

use echotank_core::model::DopplerModel;
use echotank_core::pulse::{Pulse, PulseKind};
use echotank_core::simd::SimdLevel;
use echotank_synthesis::array::Decimator;
use echotank_synthesis::array::gridded::transform::Transform1d;
use echotank_synthesis::array::gridded::{DopplerSpan, Gridded1d, one_dimensional::Spec};
use echotank_synthesis::arrivals::{ArrivalChunk, ArrivalSink, CHUNK};
use echotank_testing::allocations;
use num_complex::{Complex32, Complex64};

#[test]
fn transforms_and_elements_allocate_nothing() {
    let _alone = allocations::alone();
    let pulse = Pulse {
        kind: PulseKind::LfmUp,
        center_frequency_hz: 400e3,
        bandwidth_hz: 24e3,
        duration_s: 2e-3,
        taper: 0.5,
    };
    let filter = Decimator::new(&pulse, 40e3, 900.0, 12).unwrap();
    let span = DopplerSpan {
        least: -2e-3,
        greatest: 2e-3,
    };
    let mut chunk = ArrivalChunk::new();
    chunk.len = CHUNK;
    for i in 0..CHUNK {
        chunk.delay_s[i] = 1e-4 * i as f64;
        chunk.doppler[i] = 1.5e-5 * (i as f64 - 128.0);
        chunk.curvature_per_s[i] = 3e-5 * (i as f64 - 128.0);
        chunk.amplitude[i] = Complex64::ONE;
    }
    let mut out = vec![Complex64::ZERO; 1200];

    // One and several Doppler columns, with f32, mixed and f64 precision.
    for doppler in [
        DopplerModel::None,
        DopplerModel::Stretch,
        DopplerModel::StretchQuadratic,
    ] {
        for tolerance in [1e-2, 1e-5, 1e-8] {
            let spec = Spec {
                pulse: &pulse,
                sample_rate_hz: 40e3,
                samples: out.len(),
                filter: Some(&filter),
                doppler,
                span,
                curvature_per_s: 4e-3,
                tolerance,
                level_range_db: 50.0,
                arrivals: CHUNK,
                simd_level: SimdLevel::best(),
            };
            let mut work = Gridded1d::new(&spec).unwrap().work();
            let before = allocations::in_all_threads();
            work.start(0.0, span);
            work.accept(&chunk);
            work.finish(&mut out);
            let made = allocations::in_all_threads() - before;
            assert_eq!(made, 0, "{doppler:?} {tolerance:e}");
            assert!(out.iter().any(|x| x.norm() > 0.1), "it did nothing");
        }
    }

    let plan = Transform1d::<f32>::new(1024, 0.03, 7, 2.0, SimdLevel::best());
    let mut work = plan.workspace();
    let amplitude = vec![Complex32::ONE; CHUNK];
    let mut bins = vec![Complex32::ZERO; 1024];
    let before = allocations::in_all_threads();
    plan.execute(&mut work, &chunk.delay_s, &amplitude, &mut bins);
    assert_eq!(allocations::in_all_threads(), before);
    assert!((bins[512].re - CHUNK as f32).abs() < 1e-3, "{}", bins[512]);
}
