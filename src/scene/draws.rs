//! Counter-based random numbers: the values of a scatterer depend on the scene's seed and the scatterer's index alone.
//!
//! Philox 4x32-10 (Salmon, Moraes, Dror and Shaw 2011, "Parallel random numbers: as easy as 1, 2, 3", SC11). It uses integers only, so results are
//! the same on every machine and in any order.

use num_complex::Complex32;

const MULTIPLIERS: [u32; 2] = [0xD251_1F53, 0xCD9E_8D57];
const KEY_STEPS: [u32; 2] = [0x9E37_79B9, 0xBB67_AE85];
const ROUNDS: usize = 10;

/// Separates these numbers from other uses of the same seed. A change of the algorithm needs a new value.
const SEABED: u32 = 0x5EAB_ED02;

/// Philox 4x32-10: four random words from a counter and a key.
#[inline(always)]
pub fn philox(mut counter: [u32; 4], mut key: [u32; 2]) -> [u32; 4] {
    for _ in 0..ROUNDS {
        let a = u64::from(counter[0]) * u64::from(MULTIPLIERS[0]);
        let b = u64::from(counter[2]) * u64::from(MULTIPLIERS[1]);
        counter = [
            (b >> 32) as u32 ^ counter[1] ^ key[0],
            b as u32,
            (a >> 32) as u32 ^ counter[3] ^ key[1],
            a as u32,
        ];
        key = [
            key[0].wrapping_add(KEY_STEPS[0]),
            key[1].wrapping_add(KEY_STEPS[1]),
        ];
    }
    counter
}

fn key_of(seed: u64) -> [u32; 2] {
    [seed as u32, (seed >> 32) as u32]
}

/// Four random words of a cell of level 0: two for its position, two for its reflectivity.
#[inline(always)]
pub(crate) fn of_cell(seed: u64, north: i64, east: i64) -> [u32; 4] {
    // The counter holds 48 bits of each index: 2.8e14 cells in each direction.
    let high = (north >> 32) as u32 & 0xFFFF | ((east >> 32) as u32) << 16;
    philox([north as u32, east as u32, high, SEABED], key_of(seed))
}

/// A fair coin for a cell of a level: which of its two halves represents it.
#[inline(always)]
pub(crate) fn half_of(seed: u64, level: u32, north: i64, east: i64) -> i64 {
    (mixed_cell(seed, level, north, east) >> 63) as i64
}

/// Random bits of a cell of a level. SplitMix64's finaliser (Steele, Lea and Flood 2014).
#[inline(always)]
fn mixed_cell(seed: u64, level: u32, north: i64, east: i64) -> u64 {
    let mut z = seed
        ^ (north as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15)
        ^ (east as u64).wrapping_mul(0xC2B2_AE3D_27D4_EB4F)
        ^ u64::from(level).wrapping_mul(0x1656_67B1_9E37_79F9);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// Uniform in [0, 1), for the rank of a cell of level 0 among those of its level.
#[inline(always)]
pub(crate) fn rank(seed: u64, north: i64, east: i64) -> f64 {
    (mixed_cell(seed, 0, north, east) >> 32) as f64 / 4_294_967_296.0
}

/// Uniform in [0, 1).
#[inline(always)]
pub fn fraction(word: u32) -> f64 {
    f64::from(word) / 4_294_967_296.0
}

/// Circular Gaussian with E|z|^2 = 1 (Box and Muller 1958). Only IEEE operations, so that the bits are the same on every machine.
#[inline(always)]
pub fn circular_gaussian(a: u32, b: u32) -> Complex32 {
    // In (0, 1], so that the logarithm is finite.
    let u = (a as f32 + 0.5) * (1.0 / 4_294_967_296.0);
    let radius = (-ln(u)).max(0.0).sqrt();
    let (sin, cos) = sin_cos_turn(b);
    Complex32::new(radius * cos, radius * sin)
}

/// Natural logarithm of a normal positive number, to 2e-7 of its value or of 1.
#[inline(always)]
fn ln(x: f32) -> f32 {
    // x = 2^exponent m, with m from sqrt(1/2) to sqrt(2).
    const ROOT_HALF: u32 = 0x3F35_04F3;
    let bits = x.to_bits().wrapping_sub(ROOT_HALF);
    let exponent = (bits as i32 >> 23) as f32;
    let m = f32::from_bits((bits & 0x007F_FFFF) + ROOT_HALF);
    // ln m = 2 artanh((m - 1) / (m + 1)); the next term of the series is below 1e-9.
    let s = (m - 1.0) / (m + 1.0);
    let q = s * s;
    let series = q * (1.0 / 3.0 + q * (0.2 + q * (1.0 / 7.0 + q * (1.0 / 9.0))));
    exponent * std::f32::consts::LN_2 + 2.0 * (s + s * series)
}

/// Sine and cosine of a fraction of a turn, in units of 2^-32 turns, to 1e-7.
#[inline(always)]
pub(crate) fn sin_cos_turn(turn: u32) -> (f32, f32) {
    // Nearest quarter of a turn, and the rest, up to an eighth of a turn either way.
    let quarter = turn.wrapping_add(1 << 29) >> 30;
    let rest = turn.wrapping_sub(quarter << 30) as i32;
    let x = rest as f32 * (std::f32::consts::TAU / 4_294_967_296.0);
    // Taylor series.
    let q = x * x;
    let sin = x - x * q * (1.0 / 6.0 - q * (1.0 / 120.0 - q * (1.0 / 5_040.0 - q / 362_880.0)));
    let cos = 1.0 - q * (0.5 - q * (1.0 / 24.0 - q * (1.0 / 720.0 - q / 40_320.0)));
    let (a, b) = if quarter & 1 == 0 {
        (sin, cos)
    } else {
        (cos, sin)
    };
    let a = if quarter & 2 == 0 { a } else { -a };
    let b = if (quarter + 1) & 2 == 0 { b } else { -b };
    (a, b)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Test vectors of the authors' code (Random123, `kat_vectors`).
    #[test]
    fn philox_agrees_with_its_authors_vectors() {
        for (counter, key, want) in [
            (
                [0; 4],
                [0; 2],
                [0x6627_e8d5, 0xe169_c58d, 0xbc57_ac4c, 0x9b00_dbd8],
            ),
            (
                [u32::MAX; 4],
                [u32::MAX; 2],
                [0x408f_276d, 0x41c8_3b0e, 0xa20b_c7c6, 0x6d54_51fd],
            ),
            (
                [0x243f_6a88, 0x85a3_08d3, 0x1319_8a2e, 0x0370_7344],
                [0xa409_3822, 0x299f_31d0],
                [0xd16c_fe09, 0x94fd_cceb, 0x5001_e420, 0x2412_6ea1],
            ),
        ] {
            let got = philox(counter, key);
            assert!(got == want, "{got:x?} against {want:x?}");
        }
    }

    #[test]
    fn elementary_functions_agree_with_the_library() {
        let mut worst = [0.0_f64; 2];
        for k in 0..1_000_000_u32 {
            let word = k.wrapping_mul(2_654_435_761);
            let u = (word as f32 + 0.5) * (1.0 / 4_294_967_296.0);
            let want = f64::from(u).ln();
            worst[0] = worst[0].max((f64::from(ln(u)) - want).abs() / want.abs().max(1.0));
            let (sin, cos) = sin_cos_turn(word);
            let turn = std::f64::consts::TAU * fraction(word);
            let off = (f64::from(sin) - turn.sin()).abs();
            worst[1] = worst[1].max(off).max((f64::from(cos) - turn.cos()).abs());
        }
        println!("{worst:?}");
        assert!(worst[0] < 2e-7 && worst[1] < 1.5e-7, "{worst:?}");
        assert!(circular_gaussian(0, 0).is_finite() && circular_gaussian(u32::MAX, 1).is_finite());
    }

    #[test]
    fn coins_are_fair_and_neighbours_independent() {
        // 10^5 coins have a standard deviation of 158. Four of them are allowed.
        const ALLOWED: i64 = 640;
        let coin = |n: i64, e: i64, level| half_of(42, level, n - 160, e - 160);
        let (mut heads, mut alike) = (0, [0; 3]);
        for i in 0..100_000 {
            let (n, e) = (i / 317, i % 317);
            let here = coin(n, e, 3);
            heads += here;
            alike[0] += i64::from(here == coin(n, e + 1, 3));
            alike[1] += i64::from(here == coin(n + 1, e, 3));
            alike[2] += i64::from(here == coin(n, e, 4));
        }
        for count in [heads, alike[0], alike[1], alike[2]] {
            assert!((count - 50_000).abs() < ALLOWED, "{heads} {alike:?}");
        }
    }

    #[test]
    fn distant_cells_have_different_numbers() {
        let here = of_cell(1, 5, -7);
        for (north, east) in [(5 + (1 << 32), -7), (5, -7 + (1 << 40)), (-7, 5), (5, 7)] {
            assert_ne!(here, of_cell(1, north, east), "{north} {east}");
        }
        assert_ne!(here, of_cell(2, 5, -7));
    }
}
