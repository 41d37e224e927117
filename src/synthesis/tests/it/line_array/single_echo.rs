//! Tests of the single-echo error of the line-array engine.

use echotank_core::model::Synthesis;
use echotank_core::pulse::{Pulse, PulseKind};
use echotank_synthesis::array::Decimator;
use echotank_synthesis::array::filter;
use echotank_synthesis::array::gridded::kernel::Kernel;
use echotank_synthesis::array::gridded2d::single_echo::SingleEcho;

fn pulse(taper: f64) -> Pulse {
    Pulse {
        kind: PulseKind::Cw,
        center_frequency_hz: 250e3,
        bandwidth_hz: 0.0,
        duration_s: 0.6e-3,
        taper,
    }
}

fn alone(taper: f64) -> SingleEcho {
    let (pulse, rate_hz) = (pulse(taper), 26e3);
    let dense = filter::oversample(&pulse, rate_hz, Synthesis::Gridded2d);
    let decimator = Decimator::new(&pulse, rate_hz, 200.0, dense).expect("fits");
    SingleEcho::new(&pulse, rate_hz, &decimator, 1e-5, 80.0)
}

#[test]
fn a_kernels_error_beside_an_echo_exceeds_the_mean_and_falls_with_its_width() {
    let [sharp, soft] = [0.0, 1.0].map(alone);
    let mut last = [f64::INFINITY; 2];
    for width in [4, 5, 6, 7] {
        let kernel = Kernel::new(width, 2.0, 8);
        let [of_sharp, of_soft] = [&sharp, &soft].map(|alone| alone.kernel(&kernel, 1.0)[1]);
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
        // The stop band of the filter is 80 dB down and has at most a twentieth of a pulse. With noise 55 dB down this gives
        // 2.8e-3.
        assert!(alone.beyond_band() < 2.8e-3, "{:e}", alone.beyond_band());
    }
}

#[test]
fn a_kernel_for_the_pulses_band_has_a_third_of_the_error() {
    let pulse = Pulse {
        kind: PulseKind::LfmUp,
        center_frequency_hz: 400e3,
        bandwidth_hz: 30e3,
        duration_s: 5e-3,
        taper: 0.1,
    };
    let rate_hz = 52e3;
    let decimator = Decimator::new(&pulse, rate_hz, 2700.0, 8).expect("fits");
    let alone = SingleEcho::new(&pulse, rate_hz, &decimator, 6.7e-3, 60.0);
    let core = alone.core();
    // The band of the chirp, its Doppler of 2.7 kHz to either side, and a margin for its ends.
    assert!((0.62..0.85).contains(&core), "{core}");
    for width in [4, 5, 6] {
        let of_band = alone.kernel(&Kernel::new(width, 1.5, 8), 1.0);
        let of_core = alone.kernel(&Kernel::new(width, 1.5 / core, 8), core);
        println!("width {width}, core {core:.2}: {of_band:?}, {of_core:?}");
        assert!(of_core[0] < 0.33 * of_band[0], "{of_core:?}, {of_band:?}");
        assert!(of_core[1] < 1.5 * of_band[1], "{of_core:?}, {of_band:?}");
    }
}
