//! A platform at rest.

use echotank::array::gridded2d::{Fineness, PulseMotion};

use crate::scene::*;

/// Nothing spared.
pub const FINE: Fineness = Fineness {
    stretch: 16,
    slab_samples: 2048,
    time_width: 12,
    slope_width: 12,
    time_oversampling: 2.0,
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
