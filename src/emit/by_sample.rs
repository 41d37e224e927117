//! Samples of a fan in the order of records: by sample, then by beam.

use echotank_core::ping::BeamFrame;
use num_complex::Complex64;

/// Beams of a tile: their values of one sample fill a cache line.
const BEAMS: usize = 16;
/// Samples of a tile.
const SAMPLES: usize = 64;

/// Converts runs of samples of each beam and writes them to `into`, by sample, then by beam. Work proceeds in tiles, so that neither side
/// waits for a cache line for each value.
pub(crate) fn by_sample<T: Copy + Default>(
    fan: &BeamFrame,
    into: &mut [T],
    mut convert: impl FnMut(&[Complex64], &mut [T]),
) {
    let mut tile = [[T::default(); SAMPLES]; BEAMS];
    for beam in (0..fan.beams).step_by(BEAMS) {
        let beams = BEAMS.min(fan.beams - beam);
        for first in (0..fan.samples).step_by(SAMPLES) {
            let samples = SAMPLES.min(fan.samples - first);
            for (b, row) in tile[..beams].iter_mut().enumerate() {
                convert(&fan.beam(beam + b)[first..][..samples], &mut row[..samples]);
            }
            let rows = into[first * fan.beams..].chunks_mut(fan.beams);
            for (k, to) in rows.take(samples).enumerate() {
                for (to, row) in to[beam..].iter_mut().zip(&tile[..beams]) {
                    *to = row[k];
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_sample_of_every_beam_is_in_its_place() {
        for (beams, samples) in [(1, 1), (16, 64), (37, 150)] {
            let fan = BeamFrame {
                beams,
                samples,
                iq: (0..beams * samples)
                    .map(|n| Complex64::from(n as f64))
                    .collect(),
                ..BeamFrame::default()
            };
            let mut out = vec![0; beams * samples];
            by_sample(&fan, &mut out, |from, to| {
                for (to, from) in to.iter_mut().zip(from) {
                    *to = from.re as usize;
                }
            });
            for (n, x) in out.iter().enumerate() {
                assert_eq!(*x, n % beams * samples + n / beams);
            }
        }
    }
}
