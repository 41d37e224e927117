//! Scatterers of the seabed for one ping: selects tiles, levels and visible scatterers.
//!
//! A region is left out as a whole where the bounds of its probabilities allow it: first tiles, then blocks of tiles, then the scatterers of a block from
//! the first rank on that the ping cannot keep. The others are tested some at a time, against the footprints that reach the block.
//!
//! Work is split by tile, and the scatterers follow the order of the tiles. The result does not depend on the number of threads. Buffers grow only if
//! a ping needs more than any ping before it.

use std::ops::Range;

use glam::{DVec2, DVec3};
use num_complex::Complex64;
use rayon::prelude::*;

use super::occlusion::{Occluders, Occlusion};
use super::pool::{Slot, TilePool};
use super::seabed::Surface;
use super::targets::Targets;
use super::thinning::{self, Found, KeepProbability, Lanes};
use super::tiles::{BLOCKS_PER_TILE, CELLS_PER_BLOCK, Recipe, Tile, TileBox, TileId};
use echotank_core::ping::SceneCounts;
use echotank_core::scene::{Footprint, ScatterLaw, Scatterers};
use echotank_core::simd::widest;

/// Greatest distance of the seabed from the scene's origin, metres.
const EDGE_M: f64 = 1e9;

/// Tiles that one thread copies at a time.
const COPIED_TOGETHER: usize = 8;

/// Scatterers that the widest vectors test together; a block has a multiple of them.
const VECTOR: usize = 16;

/// Scatterer counts of one tile.
#[derive(Clone, Copy, Debug, Default)]
struct TileCount {
    made: u32,
    tested: u32,
    kept: u32,
    shadowed: u32,
    /// Index of its first scatterer in the list of the ping, and of its first hidden one.
    first: usize,
    first_hidden: usize,
}

/// Footprints of the ping, and the obstacles in their way.
#[derive(Clone, Copy)]
pub(crate) struct GatherContext<'a> {
    /// Origin of the scene in the world, metres.
    pub anchor_m: DVec3,
    pub footprints: &'a [Footprint],
    /// Shadows of these footprints, already scanned.
    pub occlusion: &'a Occlusion,
    pub surface: &'a Surface,
    pub targets: &'a Targets,
    /// Hidden scatterers are collected too.
    pub hidden: bool,
}

/// A tile of the ping.
#[derive(Clone, Copy, Debug)]
struct WantedTile {
    id: TileId,
    tile_box: TileBox,
    reach: Reach,
}

/// Which footprints a box may have scatterers of.
#[derive(Clone, Copy, Debug)]
struct Reach {
    /// No scatterer of the box has a higher probability; infinite where the density is constant.
    max_probability: f64,
    /// Bit of each of the first 64 footprints that have the box partly in range and before their faces. The others may have it there.
    footprints: u64,
}

impl Reach {
    /// Of a box that any footprint may have there.
    const ANY: u64 = u64::MAX;

    /// Whether a footprint may have the box in range and before its faces.
    #[inline(always)]
    fn may_reach(footprints: u64, index: usize) -> bool {
        index >= 64 || footprints & 1 << index != 0
    }
}

/// Buffers of tile search and collection.
#[derive(Debug, Default)]
pub(crate) struct Gatherer {
    /// Of each footprint; empty where the density is constant.
    probabilities: Vec<KeepProbability>,
    lanes: Vec<Lanes>,
    wanted: Vec<WantedTile>,
    places: Vec<Slot>,
    counts: Vec<TileCount>,
}

impl Gatherer {
    /// Writes the visible scatterers of the tiles that [`Self::find`] selected to the beginning of `out`, and returns their number. Rows after them
    /// are left undefined. `hidden` has the others afterwards, where `context` asks for them.
    pub(crate) fn collect(
        &mut self,
        recipe: &Recipe,
        pool: &mut TilePool,
        context: GatherContext,
        out: &mut Scatterers,
        hidden: &mut Scatterers,
        counts: &mut SceneCounts,
    ) -> usize {
        counts.tiles_used = self.wanted.len() as u64;
        let chances = Chances {
            footprints: context.footprints,
            probabilities: &self.probabilities,
            anchor_m: context.anchor_m,
        };
        let lanes = &self.lanes[..];
        let (mut filled, mut filled_hidden) = (0, 0);
        for batch in self.wanted.chunks(pool.capacity()) {
            pool.slots(batch.iter().map(|wanted| wanted.id), &mut self.places);
            self.counts.resize(batch.len(), TileCount::default());
            self.places
                .par_iter()
                .zip(batch)
                .zip(&mut self.counts)
                .for_each(|((place, wanted), count)| {
                    pool.work(place, recipe, |tile| {
                        *count = keep(recipe, tile, wanted, chances, lanes, context)
                    });
                });
            let (batch_first, batch_first_hidden) = (filled, filled_hidden);
            for (place, count) in self.places.iter().zip(&mut self.counts) {
                (count.first, count.first_hidden) = (filled, filled_hidden);
                filled += count.kept as usize;
                filled_hidden += count.shadowed as usize;
                counts.tiles_made += u64::from(place.stale);
                counts.made += u64::from(count.made);
                counts.shadowed += u64::from(count.shadowed);
                counts.culled += u64::from(count.tested - count.kept - count.shadowed);
            }
            if out.len() < filled {
                out.resize(filled);
            }
            let law = recipe.bottom().law;
            copy(
                pool,
                &self.places,
                &self.counts,
                &|count| count.first + count.kept as usize,
                &|tile, rows| match context.hidden {
                    true => rows.fill_some(tile, 1.0, context.anchor_m, law),
                    false => rows.fill(tile, context.anchor_m, law),
                },
                Rows::of(out, batch_first, filled),
            );
            if context.hidden {
                if hidden.len() < filled_hidden {
                    hidden.resize(filled_hidden);
                }
                copy(
                    pool,
                    &self.places,
                    &self.counts,
                    &|count| count.first_hidden + count.shadowed as usize,
                    &|tile, rows| rows.fill_some(tile, -1.0, context.anchor_m, law),
                    Rows::of(hidden, batch_first_hidden, filled_hidden),
                );
            }
        }
        if context.hidden {
            hidden.truncate(filled_hidden);
            hidden.curve.clone_from(&recipe.bottom().curve);
        }
        counts.scatterers = filled as u64;
        out.curve.clone_from(&recipe.bottom().curve);
        filled
    }

    /// Bounding boxes of the selected tiles.
    pub(crate) fn boxes(&self) -> impl Iterator<Item = &TileBox> {
        self.wanted.iter().map(|wanted| &wanted.tile_box)
    }

    /// Selects the tiles that any footprint may contain, each at the coarsest level that misses no scatterer of the ping.
    pub(crate) fn find(
        &mut self,
        recipe: &Recipe,
        anchor_m: DVec3,
        footprints: &[Footprint],
        counts: &mut SceneCounts,
    ) {
        self.wanted.clear();
        self.probabilities.clear();
        self.lanes.clear();
        let Some((low, high)) = reach(footprints, anchor_m) else {
            return;
        };
        let levels = recipe.levels();
        if let Some(thinning) = levels.thinning() {
            let of = |footprint| KeepProbability::new(thinning, footprint);
            self.probabilities.extend(footprints.iter().map(of));
        }
        let lanes = footprints.iter().enumerate();
        self.lanes
            .extend(lanes.map(|(index, f)| Lanes::new(f, self.probabilities.get(index))));
        let level = levels.no_wider_than((high - low).max_element());
        let side_m = levels.tile_m(level);
        let mut search = Search {
            recipe,
            chances: Chances {
                footprints,
                probabilities: &self.probabilities,
                anchor_m,
            },
            wanted: &mut self.wanted,
            culled: 0,
        };
        for row in Recipe::index_at(low.x, side_m.x)..=Recipe::index_at(high.x, side_m.x) {
            for col in Recipe::index_at(low.y, side_m.y)..=Recipe::index_at(high.y, side_m.y) {
                search.descend(TileId { level, row, col });
            }
        }
        counts.culled_tiles = search.culled;
    }
}

struct Search<'a> {
    recipe: &'a Recipe,
    chances: Chances<'a>,
    wanted: &'a mut Vec<WantedTile>,
    culled: u64,
}

impl Search<'_> {
    fn descend(&mut self, id: TileId) {
        let wanted = self.recipe.bounds(id).and_then(|tile_box| {
            Some(WantedTile {
                id,
                reach: self.chances.reach(&tile_box, Reach::ANY)?,
                tile_box,
            })
        });
        match wanted {
            None => self.culled += 1,
            Some(wanted) if id.level <= thinning::level(wanted.reach.max_probability) => {
                self.wanted.push(wanted);
            }
            Some(_) => {
                for half in id.halves() {
                    self.descend(half);
                }
            }
        }
    }
}

/// Footprints of a ping and their probabilities.
#[derive(Clone, Copy)]
struct Chances<'a> {
    footprints: &'a [Footprint],
    /// Empty where the density is constant.
    probabilities: &'a [KeepProbability],
    anchor_m: DVec3,
}

impl Chances<'_> {
    /// Of a box, all of whose scatterers may be of the footprints `among` only; none if no footprint may contain a point of it.
    fn reach(&self, tile_box: &TileBox, among: u64) -> Option<Reach> {
        let mut contained = false;
        let mut reach = Reach {
            max_probability: 0.0,
            footprints: 0,
        };
        for (index, footprint) in self.footprints.iter().enumerate() {
            if !Reach::may_reach(among, index) {
                continue;
            }
            let apex_m = footprint.apex_m - self.anchor_m;
            if let Some(below) = tile_box.below(footprint, apex_m) {
                contained |= below <= footprint.depth;
                let own = self.probabilities.get(index).map_or(f64::INFINITY, |own| {
                    own.max_probability(tile_box, apex_m, below)
                });
                reach.max_probability = reach.max_probability.max(own);
                if index < 64 {
                    reach.footprints |= 1 << index;
                }
            }
        }
        contained.then_some(reach)
    }
}

/// Horizontal bounding rectangle of all footprints in scene coordinates. None without footprints, and beyond the edge.
fn reach(footprints: &[Footprint], anchor_m: DVec3) -> Option<(DVec2, DVec2)> {
    let (low, high) = footprints
        .iter()
        .map(|f| {
            let apex = (f.apex_m - anchor_m).truncate();
            (apex - f.max_range_m, apex + f.max_range_m)
        })
        .reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)))?;
    (low.min_element() >= -EDGE_M && high.max_element() <= EDGE_M).then_some((low, high))
}

/// Lists the scatterers of a tile that the ping keeps and that lie in a footprint whose transmitter and receiver both see them. Makes those that it may
/// keep.
fn keep(
    recipe: &Recipe,
    tile: &mut Tile,
    wanted: &WantedTile,
    chances: Chances,
    lanes: &[Lanes],
    context: GatherContext,
) -> TileCount {
    let WantedTile {
        id,
        tile_box,
        reach: of_tile,
    } = wanted;
    let around = context.occluders(tile_box);
    let mut count = TileCount::default();
    let (mut kept, mut gains) = (
        std::mem::take(&mut tile.kept),
        std::mem::take(&mut tile.gain),
    );
    kept.clear();
    gains.clear();
    for block in 0..BLOCKS_PER_TILE {
        let block_box = tile_box.of_block(block);
        let Some(reach) = chances.reach(&block_box, of_tile.footprints) else {
            continue;
        };
        let max_rank = thinning::max_rank(reach.max_probability, id.level);
        let (rows, made) = recipe.make(*id, block, max_rank, tile);
        let around = match around {
            Occluders {
                ground: None,
                solids: None,
                ..
            } => around,
            _ => context.occluders(&block_box),
        };
        let first = block * CELLS_PER_BLOCK;
        let tested = widest(
            #[inline(always)]
            || {
                test(
                    tile,
                    first..first + rows,
                    id.level,
                    chances,
                    lanes,
                    reach.footprints,
                )
            },
        );
        // Appended without a branch, which would be predicted wrong for every other scatterer.
        let (mut indices, mut factors, mut some) =
            ([0; CELLS_PER_BLOCK], [0.0; CELLS_PER_BLOCK], 0);
        let hidden = around.ground.is_some() || around.solids.is_some();
        for (i, mut gain) in (first..first + rows).zip(tested) {
            let is_kept = gain > 0.0;
            if hidden && is_kept && !context.sees(tile.position_m(i), around) {
                count.shadowed += 1;
                if !context.hidden {
                    continue;
                }
                // Marked by the sign.
                gain = -gain;
            }
            (indices[some], factors[some]) = (i as u16, gain);
            some += usize::from(is_kept);
        }
        kept.extend_from_slice(&indices[..some]);
        gains.extend_from_slice(&factors[..some]);
        count.tested += tile.on_seabed(first..first + rows);
        count.made += tile.on_seabed(first + rows - made..first + rows);
    }
    tile.kept = kept;
    tile.gain = gains;
    count.kept = tile.kept.len() as u32;
    if context.hidden {
        count.kept -= count.shadowed;
    }
    count
}

/// Factors on the strengths of the scatterers in some rows of a block, in shadow or not; 0 for those that the ping does not keep. Rows after them have
/// any factor. Only the footprints `among` have the block in reach.
#[inline(always)]
fn test(
    tile: &Tile,
    rows: Range<usize>,
    level: u32,
    chances: Chances,
    lanes: &[Lanes],
    among: u64,
) -> [f32; CELLS_PER_BLOCK] {
    let mut found = Found::NOTHING;
    // Whole vectors: what lies in the further rows is not used.
    let end = rows.start + rows.len().next_multiple_of(VECTOR);
    let (grounds, ranks) = tile.grounds(rows.start..end);
    for (index, (lanes, footprint)) in lanes.iter().zip(chances.footprints).enumerate() {
        if !Reach::may_reach(among, index) {
            continue;
        }
        let offset_m = tile.zero_m + (chances.anchor_m - footprint.apex_m);
        let offset_m = offset_m.as_vec3().to_array();
        lanes.test(
            chances.probabilities.get(index),
            offset_m,
            grounds,
            &mut found,
        );
    }
    match chances.probabilities {
        [] => found.contained.map(|contained| contained as f32),
        _ => thinning::gains(ranks, &found, level),
    }
}

impl<'a> GatherContext<'a> {
    /// What may hide the scatterers in a box.
    fn occluders(&self, tile_box: &TileBox) -> Occluders<'a> {
        Occluders {
            ground: self.occlusion.ground_before(tile_box, self.surface),
            solids: self.occlusion.solids_before(tile_box, self.targets),
            on_ground: true,
        }
    }

    /// Whether the transmitter and the receiver of a footprint that contains a scatterer both see it. Some footprint contains it.
    #[inline(always)]
    fn sees(&self, own_m: DVec3, around: Occluders) -> bool {
        let position_m = own_m + self.anchor_m;
        let mut footprints = self.footprints.iter().enumerate();
        footprints.any(|(index, footprint)| {
            footprint.contains(position_m) && self.occlusion.sees(index, own_m, around)
        })
    }
}

/// Rows of the output that one task writes.
struct Rows<'a> {
    /// Index of the first row in the whole list.
    first: usize,
    north_m: &'a mut [f64],
    east_m: &'a mut [f64],
    down_m: &'a mut [f64],
    normal: &'a mut [[f32; 3]],
    strength: &'a mut [Complex64],
    law: &'a mut [ScatterLaw],
    loud: &'a mut [f32],
}

impl<'a> Rows<'a> {
    fn of(out: &'a mut Scatterers, from: usize, to: usize) -> Self {
        Self {
            first: from,
            north_m: &mut out.north_m[from..to],
            east_m: &mut out.east_m[from..to],
            down_m: &mut out.down_m[from..to],
            normal: &mut out.normal[from..to],
            strength: &mut out.strength[from..to],
            law: &mut out.law[from..to],
            loud: &mut out.loud[from..to],
        }
    }

    /// Splits into the rows before `row` of the whole list and the rest.
    fn split_at(self, row: usize) -> (Self, Self) {
        let n = row - self.first;
        let north_m = self.north_m.split_at_mut(n);
        let east_m = self.east_m.split_at_mut(n);
        let down_m = self.down_m.split_at_mut(n);
        let normal = self.normal.split_at_mut(n);
        let strength = self.strength.split_at_mut(n);
        let law = self.law.split_at_mut(n);
        let loud = self.loud.split_at_mut(n);
        (
            Self {
                first: self.first,
                north_m: north_m.0,
                east_m: east_m.0,
                down_m: down_m.0,
                normal: normal.0,
                strength: strength.0,
                law: law.0,
                loud: loud.0,
            },
            Self {
                first: row,
                north_m: north_m.1,
                east_m: east_m.1,
                down_m: down_m.1,
                normal: normal.1,
                strength: strength.1,
                law: law.1,
                loud: loud.1,
            },
        )
    }

    /// Writes the kept scatterers of a tile to all rows.
    fn fill(self, tile: &Tile, anchor_m: DVec3, law: ScatterLaw) {
        let kept = tile.kept.iter().copied().zip(tile.gain.iter().copied());
        self.fill_with(tile, kept, anchor_m, law);
    }

    /// Writes the kept scatterers of a tile that are seen (`sign` 1) or hidden (-1) to all rows.
    fn fill_some(self, tile: &Tile, sign: f32, anchor_m: DVec3, law: ScatterLaw) {
        let kept = tile.kept.iter().copied().zip(tile.gain.iter().copied());
        let some = kept
            .map(|(i, gain)| (i, gain * sign))
            .filter(|(_, gain)| *gain > 0.0);
        self.fill_with(tile, some, anchor_m, law);
    }

    #[inline(always)]
    fn fill_with(
        self,
        tile: &Tile,
        kept: impl Iterator<Item = (u16, f32)>,
        anchor_m: DVec3,
        law: ScatterLaw,
    ) {
        let zero_m = tile.zero_m + anchor_m;
        for (row, (i, gain)) in kept.enumerate() {
            let i = usize::from(i);
            self.north_m[row] = zero_m.x + f64::from(tile.north_m[i]);
            self.east_m[row] = zero_m.y + f64::from(tile.east_m[i]);
            self.down_m[row] = zero_m.z + f64::from(tile.down_m[i]);
            self.normal[row] = tile.normal(i);
            let strength = tile.strength[i] * gain;
            self.strength[row] = Complex64::new(strength.re.into(), strength.im.into());
        }
        self.law.fill(law);
        self.loud.fill(1.0);
    }
}

/// Writes the rows of every tile, up to `end` of each, with `fill`. Splits the work in halves until a task has a few tiles.
fn copy(
    pool: &TilePool,
    places: &[Slot],
    counts: &[TileCount],
    end: &(impl Fn(&TileCount) -> usize + Sync),
    fill: &(impl Fn(&Tile, Rows) + Sync),
    mut rows: Rows,
) {
    if places.len() > COPIED_TOGETHER {
        let middle = places.len() / 2;
        let (a, b) = rows.split_at(end(&counts[middle - 1]));
        rayon::join(
            || copy(pool, &places[..middle], &counts[..middle], end, fill, a),
            || copy(pool, &places[middle..], &counts[middle..], end, fill, b),
        );
        return;
    }
    for (place, count) in places.iter().zip(counts) {
        let (of_tile, rest) = rows.split_at(end(count));
        rows = rest;
        pool.read(place, |tile| fill(tile, of_tile));
    }
}
