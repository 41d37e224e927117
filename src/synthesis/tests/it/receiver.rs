use glam::DVec3;
use num_complex::Complex64;

use echotank_core::arrays::{Receiver, ReceiverFilter, TimeVaryingGain};
use echotank_core::ping::PingPlan;
use echotank_synthesis::array::{fill_gains, receive};

use echotank_testing::echo::*;

fn plain() -> Receiver {
    Receiver {
        sample_rate_hz: 40e3,
        filter: ReceiverFilter::None,
        tvg: TimeVaryingGain::None,
        noise_db: None,
        adc_bits: None,
        full_scale_v: 1.0,
        seed: 7,
    }
}

fn through(
    plan: &PingPlan,
    receiver: &Receiver,
    element_index: usize,
    samples: &[Complex64],
) -> (Vec<Complex64>, u64) {
    let mut rx = element(DVec3::ZERO);
    rx.sensitivity_db = -180.0;
    let (mut out, mut gains) = (samples.to_vec(), Vec::new());
    fill_gains(plan, receiver, out.len(), &mut gains);
    let saturated = receive(plan, receiver, &gains, &rx, 0, element_index, &mut out);
    (out, saturated)
}

fn ramp(count: usize) -> Vec<Complex64> {
    (0..count)
        .map(|k| Complex64::new(weyl(k, 0) - 0.5, weyl(k, 1) - 0.5))
        .collect()
}

#[test]
fn a_receiver_without_stages_changes_no_bit() {
    let samples = ramp(1000);
    assert_eq!(through(&ahead(0.0), &plain(), 0, &samples), (samples, 0));
}

#[test]
fn noise_is_circular_gaussian_of_variance_n0_fs() {
    let mut receiver = plain();
    receiver.noise_db = Some(37.0);
    let count = 400_000;
    let (noise, _) = through(&ahead(0.0), &receiver, 0, &vec![Complex64::ZERO; count]);
    let mean = |f: &dyn Fn(&Complex64) -> f64| noise.iter().map(f).sum::<f64>() / count as f64;
    // uPa^2/Hz times Hz, converted to volts.
    let want = 10f64.powf((37.0 - 180.0) / 10.0) * 40e3;
    let power = mean(&|n| n.norm_sqr());
    // Five standard deviations of the mean power, 1/sqrt(N), and equally of the means of I, Q, IQ and I^2 - Q^2.
    let slack = 5.0 / (count as f64).sqrt();
    assert!((power / want - 1.0).abs() < slack, "{power:e}, {want:e}");
    for (name, got) in [
        ("mean I", mean(&|n| n.re) / want.sqrt()),
        ("mean Q", mean(&|n| n.im) / want.sqrt()),
        ("IQ", mean(&|n| n.re * n.im) / want),
        ("I2 - Q2", mean(&|n| n.re * n.re - n.im * n.im) / want),
    ] {
        assert!(got.abs() < slack, "{name}: {got:e} of {slack:e}");
    }
    // Gaussian: the fourth moment of a circular variable is 2 variance^2. A fraction exp(-x) of the power values exceeds x
    // variances.
    let fourth = mean(&|n| n.norm_sqr().powi(2)) / (want * want);
    assert!((fourth / 2.0 - 1.0).abs() < 5.0 * slack, "{fourth}");
    for x in [0.5, 1.0, 3.0] {
        let share = mean(&|n| f64::from(u8::from(n.norm_sqr() > x * want)));
        assert!((share - f64::exp(-x)).abs() < slack, "{x}: {share}");
    }
    // White: consecutive samples are uncorrelated.
    let next: Complex64 = noise.windows(2).map(|w| w[0].conj() * w[1]).sum();
    assert!(next.norm() / (count as f64 * want) < slack);
}

#[test]
fn noise_repeats_exactly_and_differs_between_pings_elements_and_seeds() {
    let mut receiver = plain();
    receiver.noise_db = Some(37.0);
    let mut plan = ahead(0.0);
    let silence = vec![Complex64::ZERO; 20_000];
    let first = through(&plan, &receiver, 0, &silence).0;
    assert_eq!(first, through(&plan, &receiver, 0, &silence).0);
    let other_element = through(&plan, &receiver, 1, &silence).0;
    plan.ping_number += 1;
    let other_ping = through(&plan, &receiver, 0, &silence).0;
    plan.ping_number -= 1;
    receiver.seed += 1;
    let other_seed = through(&plan, &receiver, 0, &silence).0;
    let power: f64 = first.iter().map(|n| n.norm_sqr()).sum();
    for other in [other_element, other_ping, other_seed] {
        let shared: Complex64 = first.iter().zip(&other).map(|(a, b)| a.conj() * b).sum();
        assert!(shared.norm() / power < 5.0 / 20_000f64.sqrt());
    }
}

/// Expected first draws. They must not depend on the machine, the compiler or the version of the crate.
#[test]
fn the_first_noise_samples_are_fixed() {
    let mut receiver = plain();
    receiver.noise_db = Some(0.0);
    receiver.sample_rate_hz = 1.0;
    let mut rx = element(DVec3::ZERO);
    rx.sensitivity_db = 0.0;
    let mut out = [Complex64::ZERO; 2];
    receive(&ahead(0.0), &receiver, &[1.0; 2], &rx, 1, 3, &mut out);
    let bits = out.map(|n| (n.re.to_bits(), n.im.to_bits()));
    assert_eq!(
        bits,
        [
            (4_602_880_013_694_402_560, 4_606_088_782_687_502_336),
            (13_804_276_804_208_295_936, 4_604_209_723_221_213_184)
        ],
        "{out:?}"
    );
}

fn gain_db(receiver: &Receiver, plan: &PingPlan, count: usize) -> Vec<f64> {
    through(plan, receiver, 0, &vec![Complex64::ONE; count])
        .0
        .iter()
        .map(|x| 20.0 * x.re.log10())
        .collect()
}

#[test]
fn gain_over_range_follows_the_law_and_its_clip() {
    let mut plan = ahead(0.0);
    plan.settings.gain_db = 12.0;
    plan.first_sample_s = -1e-4;
    for (spreading, max_db) in [(20.0, 200.0), (30.0, 60.0), (40.0, 70.0)] {
        let mut receiver = plain();
        receiver.tvg = TimeVaryingGain::Law {
            spreading,
            absorption_db_per_m: 0.096,
            max_db,
        };
        for (k, got) in gain_db(&receiver, &plan, 8000).into_iter().enumerate() {
            let r = (0.5 * C * (-1e-4 + k as f64 / 40e3)).max(0.0);
            let law = spreading * r.log10() + 2.0 * 0.096 * r;
            let want = 12.0 + law.clamp(0.0, max_db);
            assert!((got - want).abs() < 1e-9, "{r} m: {got}, {want} dB");
        }
    }
}

#[test]
fn a_gain_table_is_linear_between_its_points_and_held_outside() {
    let plan = ahead(0.0);
    let mut receiver = plain();
    receiver.tvg = TimeVaryingGain::Table(vec![(10.0, 5.0), (20.0, 25.0), (40.0, 15.0)]);
    let got = gain_db(&receiver, &plan, 4000);
    let at = |range_m: f64| got[(2.0 * range_m / C * 40e3).round() as usize];
    for (range_m, want) in [
        (0.0, 5.0),
        (7.5, 5.0),
        (15.0, 15.0),
        (30.0, 20.0),
        (45.0, 15.0),
        (70.0, 15.0),
    ] {
        assert!(
            (at(range_m) - want).abs() < 1e-9,
            "{range_m} m: {}",
            at(range_m)
        );
    }
    receiver.tvg = TimeVaryingGain::Table(Vec::new());
    assert!(gain_db(&receiver, &plan, 10).iter().all(|&db| db == 0.0));
}

#[test]
fn a_converter_rounds_to_its_steps_and_counts_what_it_clips() {
    let mut receiver = plain();
    receiver.adc_bits = Some(12);
    receiver.full_scale_v = 0.5;
    let step = 1.0 / 4096.0;
    let samples: Vec<_> = ramp(5000).into_iter().map(|x| 0.99 * x).collect();
    let (out, saturated) = through(&ahead(0.0), &receiver, 0, &samples);
    assert_eq!(saturated, 0);
    let mut rounding: f64 = 0.0;
    for (got, want) in out.iter().zip(&samples) {
        let code = got / step;
        assert_eq!((code.re.fract(), code.im.fract()), (0.0, 0.0));
        rounding = rounding.max((got.re - want.re).abs());
    }
    assert!(
        rounding <= 0.5 * step && rounding > 0.49 * step,
        "{rounding}"
    );
    let wild = [
        Complex64::new(0.6, -0.7),
        Complex64::new(0.2, f64::INFINITY),
        Complex64::new(-0.5, 0.4999),
    ];
    let (out, saturated) = through(&ahead(0.0), &receiver, 0, &wild);
    assert_eq!(saturated, 4, "{out:?}");
    let top = 0.5 - step;
    assert_eq!(
        out,
        [
            Complex64::new(top, -0.5),
            Complex64::new((0.2 / step).round() * step, top),
            Complex64::new(-0.5, top),
        ]
    );
}
