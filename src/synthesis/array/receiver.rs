//! Receiver chain of one element: noise, fixed gain, time-varying gain, analogue-to-digital
//! converter.

use num_complex::Complex64;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

use echotank_core::arrays::{ArrayGeometry, Receiver, TimeVaryingGain};
use echotank_core::ping::PingPlan;
use echotank_core::simd::widest;

use super::noise::add_noise;

/// Tag of the random numbers of elements, different from other uses of the same seed.
const NOISE_TAG: [u8; 8] = *b"elementn";
/// Tag of the random numbers of subarrays.
const PART_TAG: [u8; 8] = *b"partnois";

/// Addition and subtraction of this number round to an integer below 2^51. Unlike the function of the library, this vectorises.
const ROUND: f64 = 6_755_399_441_055_744.0; // 1.5 * 2^52

/// Applies the receiver to the samples of one element in place. `gains` are those of [`fill_gains`] for at least as many samples.
/// Returns the number of I or Q values that clip at the converter.
///
/// The noise is circular Gaussian with variance N_0 f_s, in volts after `array.sensitivity_db`.
/// Each (seed, sonar, ping, array, element) has its own random stream. The noise therefore depends
/// neither on the order of computation nor on the machine. A subarray receives the mean of its
/// elements' noise, drawn from a separate stream. Level and spectrum of the noise of the line are
/// the same as without subarrays, but its samples are not.
pub fn receive(
    plan: &PingPlan,
    receiver: &Receiver,
    gains: &[f64],
    array: &ArrayGeometry,
    array_index: usize,
    element: usize,
    samples: &mut [Complex64],
) -> u64 {
    if let Some(noise_db) = receiver.noise_db {
        let variance =
            10f64.powf((noise_db + array.sensitivity_db) / 10.0) * receiver.sample_rate_hz;
        let (variance, tag) = match array.element_pattern.stands_for() {
            1 => (variance, NOISE_TAG),
            of => (variance / of as f64, PART_TAG),
        };
        let rng = noise_stream(plan, receiver.seed, (array_index, element), tag);
        add_noise(variance.sqrt(), rng, samples);
    }
    assert!(samples.len() <= gains.len(), "one gain for each sample");
    let amplified = &mut *samples;
    widest(
        #[inline(always)]
        move || {
            for (sample, gain) in amplified.iter_mut().zip(gains) {
                *sample *= gain;
            }
        },
    );
    match receiver.adc_bits {
        Some(bits) => quantise(bits, receiver.full_scale_v, samples),
        None => 0,
    }
}

fn noise_stream(
    plan: &PingPlan,
    seed: u64,
    (array, element): (usize, usize),
    tag: [u8; 8],
) -> ChaCha8Rng {
    let mut key = [0; 32];
    key[..8].copy_from_slice(&seed.to_le_bytes());
    key[8..12].copy_from_slice(&plan.ping_number.to_le_bytes());
    key[12..16].copy_from_slice(&(plan.sonar as u32).to_le_bytes());
    key[16..20].copy_from_slice(&(array as u32).to_le_bytes());
    key[20..24].copy_from_slice(&(element as u32).to_le_bytes());
    key[24..].copy_from_slice(&tag);
    ChaCha8Rng::from_seed(key)
}

/// Fills `gains` with the linear gain of each of the first `samples` samples of a ping: the fixed gain and the time-varying law
/// at slant range c t / 2.
pub fn fill_gains(plan: &PingPlan, receiver: &Receiver, samples: usize, gains: &mut Vec<f64>) {
    let fixed = linear(plan.settings.gain_db);
    let range_m = |k: usize| {
        let time_s = plan.first_sample_s + k as f64 / receiver.sample_rate_hz;
        0.5 * plan.sound_speed_m_per_s * time_s.max(0.0)
    };
    gains.clear();
    match &receiver.tvg {
        TimeVaryingGain::None => gains.resize(samples, fixed),
        TimeVaryingGain::Law {
            spreading,
            absorption_db_per_m,
            max_db,
        } => gains.extend((0..samples).map(|k| {
            let r = range_m(k);
            // log10(0) is minus infinity, and the limit below changes it to 0 dB.
            let law_db = spreading * libm::log10(r) + 2.0 * absorption_db_per_m * r;
            fixed * linear(law_db.min(*max_db).max(0.0))
        })),
        TimeVaryingGain::Table(table) => {
            let mut next = 0;
            gains.extend((0..samples).map(|k| {
                let r = range_m(k);
                while next < table.len() && table[next].0 <= r {
                    next += 1;
                }
                fixed * linear(table_db(table, next, r))
            }));
        }
    }
}

/// Converts dB to a linear amplitude, with the same bits on every machine.
fn linear(db: f64) -> f64 {
    libm::exp(db * (std::f64::consts::LN_10 / 20.0))
}

/// Interpolates between `table[next - 1]` and `table[next]`, constant outside; 0 dB for an empty
/// table.
fn table_db(table: &[(f64, f64)], next: usize, range_m: f64) -> f64 {
    match (next.checked_sub(1).map(|i| table[i]), table.get(next)) {
        (None, None) => 0.0,
        (None, Some(&(_, db))) | (Some((_, db)), None) => db,
        (Some((r0, db0)), Some(&(r1, db1))) => db0 + (db1 - db0) * (range_m - r0) / (r1 - r0),
    }
}

/// Rounds I and Q to steps of 2 full_scale / 2^bits, clips them at the converter's limits and
/// counts the clipped values.
pub(super) fn quantise(bits: u32, full_scale_v: f64, samples: &mut [Complex64]) -> u64 {
    let codes = 2f64.powi(bits as i32);
    let step = 2.0 * full_scale_v / codes;
    let codes_per_v = 1.0 / step;
    let (lowest, highest) = (-0.5 * codes, 0.5 * codes - 1.0);
    widest(
        #[inline(always)]
        move || {
            let mut saturated = 0;
            for sample in samples {
                let convert = |volts: f64| {
                    // Within these limits the sum rounds to the nearest integer, ties to even.
                    let limited = (volts * codes_per_v).clamp(lowest - 1.0, highest + 1.0);
                    let code = (limited + ROUND) - ROUND;
                    let is_clipped = (code < lowest) | (code > highest);
                    (code.clamp(lowest, highest) * step, u64::from(is_clipped))
                };
                let ((re, re_clipped), (im, im_clipped)) = (convert(sample.re), convert(sample.im));
                *sample = Complex64::new(re, im);
                saturated += re_clipped + im_clipped;
            }
            saturated
        },
    )
}
