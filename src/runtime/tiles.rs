//! Tiled computation of a ping: the first samples are sent while later samples are computed (`run.stream_tiles`).
//!
//! A tile is the ping truncated at the end of a block. Each tile is twice as long as the one before, and the last tile is the whole ping. A
//! sample does not depend on later echoes, so a tile equals the beginning of the whole ping bit for bit. All tiles together cost less than
//! three pings. If a ping takes at most a quarter of its window to compute, each tile is ready before its samples are due.
//!
//! The first tiles precede the earliest possible echo. They need the ping plan but no scatterers, so the first tile is sent as soon as a trigger
//! arrives. The scene is gathered meanwhile. The following tiles start again with one block.
//!
//! Tiles need methods that sum echo by echo (`reference`, `direct`). Element faults can depend on the whole ping, so a ping with element faults is
//! one tile.

use echotank_emit::blocks::end_of_block;

/// Ends of the tiles after the first `after` blocks, as (blocks, samples). The last tile, which is the whole ping, is not included.
pub(crate) fn tile_ends(
    after: u32,
    samples: usize,
    rate_hz: f64,
    block_s: f64,
) -> impl Iterator<Item = (u32, usize)> {
    let doubled = std::iter::successors(Some(1_u32), |blocks| blocks.checked_mul(2));
    let blocks = doubled.map_while(move |blocks| after.checked_add(blocks));
    let ends = blocks.map(move |blocks| (blocks, end_of_block(blocks, rate_hz, block_s)));
    let mut before = end_of_block(after, rate_hz, block_s);
    ends.take_while(move |&(_, end)| end < samples)
        // A block shorter than a sample adds no tile.
        .filter(move |&(_, end)| end > std::mem::replace(&mut before, end))
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::recorded::RecordedRig;
    use echotank_config::spec::{Density, RigSpec, VolumeLayer, VolumeSpec};
    use echotank_core::model::Synthesis;
    use echotank_emit::blocks::blocks;
    use echotank_ping::PingOrder;
    use echotank_ping::threads::pool;

    #[test]
    fn tiles_double_in_length_and_end_with_blocks() {
        let ends: Vec<_> = tile_ends(0, 1000, 40e3, 1e-3).collect();
        assert_eq!(ends, [(1, 40), (2, 80), (4, 160), (8, 320), (16, 640)]);
        assert_eq!(tile_ends(0, 40, 40e3, 1e-3).count(), 0);
        let ends: Vec<_> = tile_ends(20, 1000, 40e3, 1e-3).collect();
        assert_eq!(ends, [(21, 840), (22, 880), (24, 960)]);
        assert_eq!(tile_ends(u32::MAX, 1000, 40e3, 1e-3).count(), 0);
        for (samples, rate_hz, block_s) in [(5000, 44_100.0, 0.37e-3), (77, 1e4, 1e-5)] {
            let of_blocks: Vec<_> = blocks(samples, rate_hz, Some(block_s))
                .map(|(rows, _)| rows.end)
                .collect();
            let ends = tile_ends(0, samples, rate_hz, block_s);
            let ends: Vec<_> = ends.map(|(_, end)| end).collect();
            assert!(ends.iter().all(|end| of_blocks.contains(end)), "{ends:?}");
            assert!(ends.windows(2).all(|w| w[1] > w[0]), "{ends:?}");
            assert!(ends.iter().sum::<usize>() < 2 * samples, "{ends:?}");
        }
    }

    /// Compares tiles with the whole ping. Returns the numbers of blocks compared before and after the earliest possible echo.
    fn tiles_of(file: &str, adapt: impl Fn(&mut RigSpec)) -> (u32, u32) {
        const BLOCK_S: f64 = 1e-3;
        let path = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../..")).join("hil-configs");
        let mut spec = crate::config_files::load(&path.join(file)).expect("sound");
        for sonar in &mut spec.sonars {
            sonar.model.synthesis = Synthesis::Direct;
        }
        adapt(&mut spec);
        pool(2).expect("threads").install(|| {
            let RecordedRig {
                mut rig,
                mut inputs,
                first,
                ..
            } = RecordedRig::open(&spec).expect("opens");
            let sonar = &spec.sonars[0];
            let order = PingOrder {
                ping_number: 3,
                transmit_utc: first,
                settings: sonar.settings,
                period_s: 1.0,
            };
            assert!(crate::rig::read_navigation_for(
                &mut rig,
                &mut inputs,
                0,
                &order
            ));
            let (mut slot, mut tile) = (rig.slot(0), rig.slot(0));
            echotank_ping::make_ping::motion(&mut rig, 0, &order, spec.nav.mode, first, &mut slot)
                .expect("planned");
            let (samples, rate_hz) = (slot.plan.sample_count, sonar.receiver.sample_rate_hz);
            let mut made = Vec::new();
            let mut quiet = 0;
            for (blocks, end) in tile_ends(0, samples, rate_hz, BLOCK_S) {
                if !rig.begin_quiet(0, &mut slot, end, &mut tile) {
                    break;
                }
                quiet = blocks;
                made.push((end, tile.output.elements.clone()));
            }
            echotank_ping::make_ping::gather(&mut rig, 0, &mut slot);
            let mut last = quiet;
            for (blocks, end) in tile_ends(quiet, samples, rate_hz, BLOCK_S) {
                let is_first = last == quiet;
                assert!(rig.begin(0, &mut slot, (end, is_first), &mut tile));
                last = blocks;
                made.push((end, tile.output.elements.clone()));
            }
            echotank_ping::finish_ping(&mut rig, 0, &mut slot);
            for (end, frames) in &made {
                for (tile, whole) in frames.iter().zip(&slot.output.elements) {
                    let of_tile = tile.iq.chunks_exact(*end);
                    let of_whole = whole.iq.chunks_exact(samples);
                    for (e, (a, b)) in of_tile.zip(of_whole).enumerate() {
                        assert!(a == &b[..*end], "{file}: element {e} up to {end} differs");
                    }
                }
            }
            let echoes = slot.output.elements[0].iq.iter();
            assert!(
                echoes.filter(|x| x.norm() > 0.0).count() > samples,
                "{file}"
            );
            (quiet, last - quiet)
        })
    }

    #[test]
    fn tiles_equal_the_beginning_of_the_ping_bit_for_bit() {
        // Points at 20 m and more, no filter, no noise.
        let (quiet, echoes) = tiles_of("points.toml", |_| {});
        assert!(quiet >= 16 && echoes >= 32, "points: {quiet} {echoes}");
        // A seabed at about 50 m, a filter, noise and a converter.
        let (quiet, echoes) = tiles_of("quickstart.toml", |spec| {
            if let Some(seabed) = &mut spec.scene.seabed {
                seabed.density = Density::PerM2(0.02);
            }
            for sonar in &mut spec.sonars {
                sonar.settings.range_m = 90.0;
                sonar.model.synthesis = Synthesis::Direct;
                sonar.synthesis.auto = Default::default();
            }
        });
        assert!(quiet >= 8 && echoes >= 32, "quickstart: {quiet} {echoes}");
        // Water that scatters and targets that move, through a filter.
        let folder = tempfile::tempdir().expect("a folder");
        let targets = folder.path().join("targets.toml");
        let text = "[[target]]\nname = \"a\"\nnorth_m = 9.0\neast_m = 30.0\ndown_m = 12.0\nvelocity_m_per_s = [1.0, 2.0, 0.0]\ntarget_strength_db = 0.0\n";
        std::fs::write(&targets, text).expect("targets");
        let (quiet, echoes) = tiles_of("quickstart.toml", |spec| {
            spec.scene.seabed = None;
            spec.scene.targets = Some(targets.clone());
            spec.medium.volume = Some(VolumeSpec {
                layers: vec![VolumeLayer {
                    top_m: 0.0,
                    bottom_m: 20.0,
                    sv_db: -60.0,
                }],
                scatterers_per_cell: 1.0,
                nearest_m: 1.0,
            });
            for sonar in &mut spec.sonars {
                sonar.settings.range_m = 40.0;
                sonar.model.synthesis = Synthesis::Direct;
                sonar.synthesis.auto = Default::default();
            }
        });
        assert!(quiet == 0 && echoes >= 32, "volume: {quiet} {echoes}");
    }
}
