//! What one echo by itself loses beside it.

use echotank::array::Decimator;
use echotank::array::filter;
use echotank::array::gridded::kernel::Kernel;
use echotank::array::gridded2d::alone::Alone;
use echotank::flow::{Pulse, PulseKind, Synthesis};

fn pulse(taper: f64) -> Pulse {
    Pulse {
        kind: PulseKind::Cw,
        center_frequency_hz: 250e3,
        bandwidth_hz: 0.0,
        duration_s: 0.6e-3,
        taper,
    }
}

fn alone(taper: f64) -> Alone {
    let (pulse, rate_hz) = (pulse(taper), 26e3);
    let dense = filter::oversample(&pulse, rate_hz, Synthesis::Gridded2d);
    let decimator = Decimator::new(&pulse, rate_hz, 200.0, dense).expect("fits");
    Alone::new(&pulse, rate_hz, &decimator, 1e-5, 80.0)
}

#[test]
fn a_kernel_errs_by_more_beside_an_echo_than_in_the_mean_and_less_so_the_wider_it_is() {
    let [sharp, soft] = [0.0, 1.0].map(alone);
    let mut last = [f64::INFINITY; 2];
    for width in [4, 5, 6, 7] {
        let kernel = Kernel::new(width, 2.0, 8);
        let [of_sharp, of_soft] = [&sharp, &soft].map(|alone| alone.kernel(&kernel));
        println!(
            "width {width}: rms {:.1e}, sharp {of_sharp:.1e}, soft {of_soft:.1e}",
            kernel.error
        );
        for (got, last) in [of_sharp, of_soft].into_iter().zip(&mut last) {
            assert!(got > 2.0 * kernel.error && got < 0.3 * *last, "{got:e}");
            *last = got;
        }
    }
    for alone in [sharp, soft] {
        // The filter's stop band lies 80 dB down and little of a pulse beyond it, a twentieth at most: in noise 40 dB down that is 5e-4.
        assert!(alone.beyond_band() < 5e-4, "{:e}", alone.beyond_band());
    }
}
