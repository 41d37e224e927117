//! The fast engine allocates nothing after its plans and workspaces are made.

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicU64, Ordering};

use echotank::array::Decimator;
use echotank::array::gridded::transform::Transform1d;
use echotank::array::gridded::{Dialect, DopplerSpan, Gridded1d, one_dimensional::Spec};
use echotank::flow::{ArrivalChunk, ArrivalSink, CHUNK, DopplerModel, Pulse, PulseKind};
use num_complex::{Complex32, Complex64};

struct Counting;

static ALLOCATIONS: AtomicU64 = AtomicU64::new(0);

// SAFETY: hands every request to the system's allocator unchanged; the counter touches no memory of the requests.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.fetch_add(1, Ordering::Relaxed);
        // SAFETY: the caller's promises are passed on.
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller's promises are passed on; the pointer came from `System`.
        unsafe { System.dealloc(pointer, layout) }
    }
    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, new_size: usize) -> *mut u8 {
        ALLOCATIONS.fetch_add(1, Ordering::Relaxed);
        // SAFETY: the caller's promises are passed on; the pointer came from `System`.
        unsafe { System.realloc(pointer, layout, new_size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

#[test]
fn transforms_and_elements_allocate_nothing() {
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

    // One column and many; f32, mixed and f64.
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
                dialect: Dialect::best(),
            };
            let mut work = Gridded1d::new(&spec).unwrap().work();
            let before = ALLOCATIONS.load(Ordering::Relaxed);
            work.start(0.0, span);
            work.accept(&chunk);
            work.finish(&mut out);
            let made = ALLOCATIONS.load(Ordering::Relaxed) - before;
            assert_eq!(made, 0, "{doppler:?} {tolerance:e}");
            assert!(out.iter().any(|x| x.norm() > 0.1), "it did nothing");
        }
    }

    let plan = Transform1d::<f32>::new(1024, 0.03, 7, 2.0, Dialect::best());
    let mut work = plan.workspace();
    let amplitude = vec![Complex32::ONE; CHUNK];
    let mut bins = vec![Complex32::ZERO; 1024];
    let before = ALLOCATIONS.load(Ordering::Relaxed);
    plan.execute(&mut work, &chunk.delay_s, &amplitude, &mut bins);
    assert_eq!(ALLOCATIONS.load(Ordering::Relaxed), before);
    assert!((bins[512].re - CHUNK as f32).abs() < 1e-3, "{}", bins[512]);
}
