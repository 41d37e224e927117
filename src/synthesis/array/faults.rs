//! Faults of receive channels, applied to the samples of an array.
//!
//! The input is an [`ElementFrame`] after the receiver, and the faults of this ping. The output is
//! the same frame with the faults applied. Analogue faults pass through the converter again, if
//! there is one. Random numbers depend only on seed, ping, array and element.

use num_complex::Complex64;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

use super::noise::add_noise;
use super::phasor::cis;
use super::receiver::quantise;
use echotank_config::spec::ElementFault;
use echotank_core::arrays::Receiver;
use echotank_core::ping::{ElementFrame, PingPlan};

/// Tag of these random numbers, different from that of the receiver noise.
const NOISE_TAG: [u8; 8] = *b"elementf";

/// Mains frequency, Hz.
const MAINS_HZ: f64 = 50.0;

/// State of one fault in one ping.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ActiveFault {
    /// Kind of fault and its parameters.
    pub fault: ElementFault,
    /// Index of the faulty array; `None` for every array and element.
    pub array: Option<usize>,
    /// Index of the faulty element; `None` for every element.
    pub element: Option<usize>,
    /// Fraction of the full size, 0 to 1. Kinds without a size act in full from the start.
    pub strength: f64,
    /// Seed of the random numbers.
    pub seed: u64,
}

/// Applies a fault to the samples of one array. `before` is a buffer for one element.
pub fn apply_fault(
    active: &ActiveFault,
    plan: &PingPlan,
    receiver: &Receiver,
    frame: &mut ElementFrame,
    before: &mut Vec<Complex64>,
) {
    if active.array.is_some_and(|array| array != frame.array) || frame.samples == 0 {
        return;
    }
    if let (ElementFault::Swapped { with }, Some(element)) = (active.fault, active.element) {
        swap(frame, element, with);
        return;
    }
    if let ElementFault::Crosstalk { from, db } = active.fault {
        if from >= frame.elements {
            return;
        }
        before.clear();
        before.extend_from_slice(frame.element(from));
        let leak = linear(db) * active.strength;
        each(active, frame, |element, samples| {
            if element != from {
                for (sample, other) in samples.iter_mut().zip(before.iter()) {
                    *sample += other * leak;
                }
            }
        });
    } else {
        let array = frame.array;
        each(active, frame, |element, samples| {
            one(active, plan, receiver, (array, element), samples, before);
        });
    }
    let is_digital = matches!(
        active.fault,
        ElementFault::AdcBitStuck { .. } | ElementFault::SampleSlip { .. }
    );
    if let (Some(bits), false) = (receiver.adc_bits, is_digital) {
        let mut saturated = 0;
        each(active, frame, |_, samples| {
            saturated += quantise(bits, receiver.full_scale_v, samples);
        });
        frame.saturated += saturated;
    }
}

/// Applies `f` to the samples of every faulty element.
fn each(
    active: &ActiveFault,
    frame: &mut ElementFrame,
    mut apply_fault: impl FnMut(usize, &mut [Complex64]),
) {
    match active.element {
        Some(element) if element < frame.elements => {
            apply_fault(element, frame.element_mut(element))
        }
        Some(_) => {}
        None => {
            (0..frame.elements).for_each(|element| apply_fault(element, frame.element_mut(element)))
        }
    }
}

fn swap(frame: &mut ElementFrame, a: usize, b: usize) {
    if a == b || a.max(b) >= frame.elements {
        return;
    }
    let (low, high) = frame.iq.split_at_mut(a.max(b) * frame.samples);
    let low = &mut low[a.min(b) * frame.samples..][..frame.samples];
    low.swap_with_slice(&mut high[..frame.samples]);
}

/// Converts dB to a linear amplitude.
fn linear(db: f64) -> f64 {
    libm::exp(db * (std::f64::consts::LN_10 / 20.0))
}

fn one(
    active: &ActiveFault,
    plan: &PingPlan,
    receiver: &Receiver,
    (array, element): (usize, usize),
    samples: &mut [Complex64],
    before: &mut Vec<Complex64>,
) {
    let strength = active.strength;
    match active.fault {
        ElementFault::Dead => samples.fill(Complex64::ZERO),
        ElementFault::Stuck { volts } => samples.fill(Complex64::new(volts, volts)),
        ElementFault::Inverted => samples.iter_mut().for_each(|x| *x = -*x),
        ElementFault::Gain { db } => {
            let gain = linear(db * strength);
            samples.iter_mut().for_each(|x| *x *= gain);
        }
        ElementFault::Phase { rad } => {
            let turned = cis_of(rad * strength);
            samples.iter_mut().for_each(|x| *x *= turned);
        }
        ElementFault::Clipping { volts } => {
            for x in samples {
                *x = Complex64::new(x.re.clamp(-volts, volts), x.im.clamp(-volts, volts));
            }
        }
        ElementFault::Offset { volts } => {
            let offset = Complex64::new(volts, volts) * strength;
            samples.iter_mut().for_each(|x| *x += offset);
        }
        ElementFault::NoiseBurst { volts } => {
            let mut key = [0; 32];
            key[..8].copy_from_slice(&active.seed.to_le_bytes());
            key[8..12].copy_from_slice(&plan.ping_number.to_le_bytes());
            key[12..16].copy_from_slice(&(plan.sonar as u32).to_le_bytes());
            key[16..20].copy_from_slice(&(array as u32).to_le_bytes());
            key[20..24].copy_from_slice(&(element as u32).to_le_bytes());
            key[24..].copy_from_slice(&NOISE_TAG);
            add_noise(volts * strength, ChaCha8Rng::from_seed(key), samples);
        }
        ElementFault::MainsHum { volts } => {
            // Whole mains periods are subtracted first, in nanoseconds. The product of seconds
            // since 1970 and 50 Hz would lose phase.
            let period_ns = (1e9 / MAINS_HZ) as i64;
            let first_s =
                plan.transmit_utc.0.rem_euclid(period_ns) as f64 * 1e-9 + plan.first_sample_s;
            let peak = std::f64::consts::SQRT_2 * volts * strength;
            for (k, x) in samples.iter_mut().enumerate() {
                let t_s = first_s + k as f64 / receiver.sample_rate_hz;
                let hum = peak * cis_of(std::f64::consts::TAU * MAINS_HZ * t_s).im;
                *x += Complex64::new(hum, hum);
            }
        }
        ElementFault::AdcBitStuck { bit, high } => {
            let Some(bits) = receiver.adc_bits else {
                return;
            };
            let step = 2.0 * receiver.full_scale_v / 2f64.powi(bits as i32);
            for x in samples {
                *x = Complex64::new(
                    with_bit(x.re, step, bits, bit, high),
                    with_bit(x.im, step, bits, bit, high),
                );
            }
        }
        ElementFault::ClockDrift { ppm } => {
            before.clear();
            before.extend_from_slice(samples);
            let stretch = 1.0 + ppm * strength * 1e-6;
            let first = plan.first_sample_s * receiver.sample_rate_hz;
            for (k, x) in samples.iter_mut().enumerate() {
                // Sample k is taken when t (1 + ppm) = k, with t of the correct clock.
                *x = between(before, (first + k as f64) / stretch - first);
            }
        }
        ElementFault::SampleSlip { samples: by } => {
            let by = by.min(samples.len());
            let kept = samples.len() - by;
            samples.copy_within(..kept, by);
            samples[..by].fill(Complex64::ZERO);
        }
        // Faults of two elements are handled above.
        ElementFault::Swapped { .. } | ElementFault::Crosstalk { .. } => {}
    }
}

fn cis_of(rad: f64) -> Complex64 {
    let (cos, sin) = cis(rad / std::f64::consts::TAU);
    Complex64::new(cos, sin)
}

/// Forces one bit of the two's complement code of a value on the converter's grid.
fn with_bit(volts: f64, step: f64, bits: u32, bit: u32, high: bool) -> f64 {
    let bits = bits.min(32);
    if bit >= bits {
        return volts;
    }
    let code = (volts / step).round() as i64;
    let forced = match high {
        true => code | (1 << bit),
        false => code & !(1 << bit),
    };
    // Sign-extends the code.
    let shift = 64 - bits;
    ((forced << shift) >> shift) as f64 * step
}

/// Interpolates the envelope by the Lagrange cubic through four samples; 0 outside.
fn between(samples: &[Complex64], at: f64) -> Complex64 {
    let below = at.floor();
    let t = at - below;
    let sample = |offset: i64| {
        usize::try_from(below as i64 + offset)
            .ok()
            .and_then(|k| samples.get(k).copied())
            .unwrap_or(Complex64::ZERO)
    };
    sample(-1) * (-t * (t - 1.0) * (t - 2.0) / 6.0)
        + sample(0) * ((t + 1.0) * (t - 1.0) * (t - 2.0) / 2.0)
        + sample(1) * (-(t + 1.0) * t * (t - 2.0) / 2.0)
        + sample(2) * ((t + 1.0) * t * (t - 1.0) / 6.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use echotank_core::arrays::{ReceiverFilter, TimeVaryingGain};
    use echotank_core::pulse::{Pulse, PulseKind};
    use echotank_core::testing::plan_at_rest;
    use echotank_core::time::UtcNs;

    const SAMPLES: usize = 400;
    const RATE_HZ: f64 = 20_000.0;

    fn plan() -> PingPlan {
        let pulse = Pulse {
            kind: PulseKind::Cw,
            center_frequency_hz: 1e5,
            bandwidth_hz: 0.0,
            duration_s: 1e-3,
            taper: 0.0,
        };
        plan_at_rest(&pulse, SAMPLES, 1500.0)
    }

    fn receiver(adc_bits: Option<u32>) -> Receiver {
        Receiver {
            sample_rate_hz: RATE_HZ,
            filter: ReceiverFilter::None,
            tvg: TimeVaryingGain::None,
            noise_db: None,
            adc_bits,
            full_scale_v: 8.0,
            seed: 1,
        }
    }

    /// Three elements, each with a slow tone of its own amplitude.
    fn frame() -> ElementFrame {
        let tone = |e: usize, k: usize| cis_of(0.03 * k as f64 + e as f64) * (1.0 + e as f64);
        let iq = (0..3).flat_map(|e| (0..SAMPLES).map(move |k| tone(e, k)));
        ElementFrame {
            array: 0,
            elements: 3,
            samples: SAMPLES,
            iq: iq.collect(),
            saturated: 0,
        }
    }

    fn active(fault: ElementFault) -> ActiveFault {
        ActiveFault {
            fault,
            array: Some(0),
            element: Some(1),
            strength: 1.0,
            seed: 7,
        }
    }

    /// Returns element 1 before and after the fault, and checks that the others are unchanged.
    fn spoiled(fault: ElementFault, bits: Option<u32>) -> (Vec<Complex64>, Vec<Complex64>) {
        let (mut frame, was) = (frame(), frame());
        apply_fault(
            &active(fault),
            &plan(),
            &receiver(bits),
            &mut frame,
            &mut Vec::new(),
        );
        assert_eq!(frame.element(0), was.element(0), "{fault:?}");
        assert_eq!(frame.element(2), was.element(2), "{fault:?}");
        (was.element(1).to_vec(), frame.element(1).to_vec())
    }

    fn assert_each(fault: ElementFault, want: impl Fn(&[Complex64], usize) -> Complex64) {
        let (was, got) = spoiled(fault, None);
        for (k, got) in got.iter().enumerate() {
            let want = want(&was, k);
            assert!((got - want).norm() < 1e-12, "{fault:?} {k}: {got} {want}");
        }
    }

    #[test]
    fn dead_stuck_and_inverted() {
        assert_each(ElementFault::Dead, |_, _| Complex64::ZERO);
        assert_each(ElementFault::Stuck { volts: 0.25 }, |_, _| {
            Complex64::new(0.25, 0.25)
        });
        assert_each(ElementFault::Inverted, |was, k| -was[k]);
    }

    #[test]
    fn gain_phase_offset_and_clipping() {
        assert_each(ElementFault::Gain { db: -20.0 }, |was, k| was[k] * 0.1);
        let quarter = std::f64::consts::FRAC_PI_2;
        assert_each(ElementFault::Phase { rad: quarter }, |was, k| {
            was[k] * Complex64::I
        });
        assert_each(ElementFault::Offset { volts: 0.5 }, |was, k| {
            was[k] + Complex64::new(0.5, 0.5)
        });
        assert_each(ElementFault::Clipping { volts: 1.5 }, |was, k| {
            Complex64::new(was[k].re.clamp(-1.5, 1.5), was[k].im.clamp(-1.5, 1.5))
        });
    }

    #[test]
    fn faults_at_half_strength_are_half_as_large() {
        let mut half = active(ElementFault::Gain { db: -20.0 });
        half.strength = 0.5;
        let (mut frame, was) = (frame(), frame());
        apply_fault(&half, &plan(), &receiver(None), &mut frame, &mut Vec::new());
        let ratio = frame.element(1)[5].norm() / was.element(1)[5].norm();
        assert!((20.0 * ratio.log10() + 10.0).abs() < 1e-9, "{ratio}");
    }

    #[test]
    fn swapped_elements_exchange_their_samples() {
        let (mut frame, was) = (frame(), frame());
        let fault = active(ElementFault::Swapped { with: 2 });
        apply_fault(
            &fault,
            &plan(),
            &receiver(None),
            &mut frame,
            &mut Vec::new(),
        );
        assert_eq!(frame.element(1), was.element(2));
        assert_eq!(frame.element(2), was.element(1));
        assert_eq!(frame.element(0), was.element(0));
    }

    #[test]
    fn crosstalk_adds_the_other_element() {
        let other = frame();
        assert_each(ElementFault::Crosstalk { from: 2, db: -20.0 }, |was, k| {
            was[k] + other.element(2)[k] * 0.1
        });
    }

    #[test]
    fn a_noise_burst_has_its_power_and_the_same_bits_again() {
        let fault = ElementFault::NoiseBurst { volts: 2.0 };
        let (was, got) = spoiled(fault, None);
        let power: f64 = was.iter().zip(&got).map(|(a, b)| (b - a).norm_sqr()).sum();
        let rms = (power / SAMPLES as f64).sqrt();
        // The rms of 400 circular Gaussian values scatters by 1/sqrt(4 * 400) = 2.5 %; the limit is
        // four times that.
        assert!((rms / 2.0 - 1.0).abs() < 0.1, "{rms}");
        assert_eq!(got, spoiled(fault, None).1);
    }

    #[test]
    fn mains_hum_is_50_hz_and_continuous_from_ping_to_ping() {
        let hum = |utc_ns: i64| {
            let mut plan = plan();
            plan.transmit_utc = UtcNs(utc_ns);
            let mut frame = frame();
            let was = frame.clone();
            let fault = active(ElementFault::MainsHum { volts: 1.0 });
            apply_fault(&fault, &plan, &receiver(None), &mut frame, &mut Vec::new());
            let pairs = frame.element(1).iter().zip(was.element(1));
            pairs.map(|(a, b)| (a - b).re).collect::<Vec<_>>()
        };
        // 400 samples at 20 kHz are one period.
        let first = hum(0);
        let power: f64 = first.iter().map(|v| v * v).sum::<f64>() / SAMPLES as f64;
        assert!((power.sqrt() - 1.0).abs() < 1e-9, "{power}");
        // A quarter period later, after a century.
        let later = hum(3_155_760_000 * 1_000_000_000 + 5_000_000);
        for k in 0..SAMPLES - 100 {
            assert!((later[k] - first[k + 100]).abs() < 1e-6, "{k}");
        }
    }

    #[test]
    fn a_stuck_bit_is_stuck_in_every_code_and_nothing_else_changes() {
        for (bit, high) in [(3, true), (3, false), (11, true), (11, false)] {
            let mut frame = frame();
            quantise(12, 8.0, &mut frame.iq);
            let was = frame.clone();
            let fault = active(ElementFault::AdcBitStuck { bit, high });
            apply_fault(
                &fault,
                &plan(),
                &receiver(Some(12)),
                &mut frame,
                &mut Vec::new(),
            );
            let step = 16.0 / 4096.0;
            let code = |v: f64| (v / step).round() as i64 & 0xFFF;
            for (got, was) in frame.element(1).iter().zip(was.element(1)) {
                for (got, was) in [(got.re, was.re), (got.im, was.im)] {
                    let want = match high {
                        true => code(was) | 1 << bit,
                        false => code(was) & !(1 << bit),
                    };
                    assert_eq!(code(got), want, "bit {bit} {high}: {was}");
                    assert!((-8.0..8.0).contains(&got), "{got}");
                }
            }
        }
    }

    #[test]
    fn a_drifting_clock_delays_echoes_and_a_slip_shifts_them() {
        let (was, got) = spoiled(ElementFault::ClockDrift { ppm: 1000.0 }, None);
        for (k, got) in got.iter().enumerate().take(SAMPLES - 3).skip(3) {
            let at = k as f64 / 1.001;
            let want = cis_of(0.03 * at + 1.0) * 2.0;
            // A cubic through samples 0.03 rad apart has an error below 0.03^4 of the amplitude.
            assert!((got - want).norm() < 2e-6, "{k}: {got} {want}");
        }
        assert!((got[0] - was[0]).norm() < 1e-12);
        let (was, got) = spoiled(ElementFault::SampleSlip { samples: 7 }, None);
        assert!(got[..7].iter().all(|x| *x == Complex64::ZERO));
        assert_eq!(got[7..], was[..SAMPLES - 7]);
    }

    #[test]
    fn analogue_faults_stay_on_the_converters_grid() {
        let (_, got) = spoiled(ElementFault::Gain { db: 3.0 }, Some(12));
        let step = 16.0 / 4096.0;
        for x in got {
            assert_eq!(x.re, (x.re / step).round() * step);
        }
    }

    #[test]
    fn faults_of_missing_arrays_and_elements_change_nothing() {
        for (array, element) in [(Some(1), Some(1)), (Some(0), Some(9)), (Some(0), None)] {
            let (mut frame, was) = (frame(), frame());
            let fault = ActiveFault {
                array,
                element,
                ..active(ElementFault::Crosstalk { from: 9, db: 0.0 })
            };
            apply_fault(
                &fault,
                &plan(),
                &receiver(None),
                &mut frame,
                &mut Vec::new(),
            );
            assert_eq!(frame.iq, was.iq);
        }
    }
}
