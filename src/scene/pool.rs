//! Tiles kept for the next ping, within a bound; the one not used for longest makes room.

use std::collections::HashMap;
use std::sync::{Mutex, MutexGuard, PoisonError};

use super::tiles::{Recipe, Tile, TileId};

/// None, in the chain of places.
const NOWHERE: u32 = u32::MAX;

/// A place in the pool that a ping was given.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Place {
    pub id: TileId,
    index: u32,
    /// What stands there is another tile: this one must be made.
    pub stale: bool,
}

/// Allocates while it grows to its capacity, and not after.
#[derive(Debug)]
pub(crate) struct TilePool {
    capacity: usize,
    place: HashMap<TileId, u32>,
    ids: Vec<TileId>,
    /// Each tile is worked on by one thread at a time: no lock ever waits.
    tiles: Vec<Mutex<Tile>>,
    /// Chain from the place used last to the one not used for longest.
    newer: Vec<u32>,
    older: Vec<u32>,
    newest: u32,
    oldest: u32,
}

impl TilePool {
    /// Room for `capacity` tiles, at least one.
    pub(crate) fn new(capacity: usize) -> Self {
        assert!(capacity > 0, "a pool without room");
        Self {
            capacity: capacity.min(NOWHERE as usize),
            place: HashMap::new(),
            ids: Vec::new(),
            tiles: Vec::new(),
            newer: Vec::new(),
            older: Vec::new(),
            newest: NOWHERE,
            oldest: NOWHERE,
        }
    }

    pub(crate) fn capacity(&self) -> usize {
        self.capacity
    }

    /// Gives each of the tiles a place, at most as many as there is room for and none twice.
    pub(crate) fn places(
        &mut self,
        ids: impl ExactSizeIterator<Item = TileId>,
        out: &mut Vec<Place>,
    ) {
        assert!(ids.len() <= self.capacity, "more tiles than room");
        out.clear();
        // First those that are there, so that none of them makes room for another.
        for id in ids {
            let index = self.place.get(&id).copied();
            if let Some(index) = index {
                self.unlink(index);
                self.link_newest(index);
            }
            out.push(Place {
                id,
                index: index.unwrap_or(NOWHERE),
                stale: index.is_none(),
            });
        }
        for place in out.iter_mut().filter(|p| p.stale) {
            place.index = self.vacate();
            self.ids[place.index as usize] = place.id;
            self.place.insert(place.id, place.index);
            self.link_newest(place.index);
        }
    }

    /// Works on the tile of a place, made first where it was not there. To be called once for each place before any is called again.
    pub(crate) fn work<T>(
        &self,
        place: &Place,
        recipe: &Recipe,
        work: impl FnOnce(&mut Tile) -> T,
    ) -> T {
        let mut tile = self.tile(place);
        if place.stale {
            recipe.make(place.id, &mut tile);
        }
        work(&mut tile)
    }

    /// Reads a tile that was worked on.
    pub(crate) fn read<T>(&self, place: &Place, read: impl FnOnce(&Tile) -> T) -> T {
        read(&self.tile(place))
    }

    fn tile(&self, place: &Place) -> MutexGuard<'_, Tile> {
        // Whoever panicked while he held the lock took his ping with him; the lock itself is sound.
        self.tiles[place.index as usize]
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }

    /// A place that is in no chain: a new one, or that of the tile not used for longest.
    fn vacate(&mut self) -> u32 {
        if self.tiles.len() < self.capacity {
            let index = self.tiles.len() as u32;
            // An index at most half full tidies itself up in place, however often tiles come and go.
            self.place.reserve(self.tiles.len() + 2);
            self.ids.push(TileId {
                level: 0,
                row: 0,
                col: 0,
            });
            self.tiles.push(Mutex::new(Tile::with_room()));
            self.newer.push(NOWHERE);
            self.older.push(NOWHERE);
            return index;
        }
        let index = self.oldest;
        self.unlink(index);
        self.place.remove(&self.ids[index as usize]);
        index
    }

    fn unlink(&mut self, index: u32) {
        let (newer, older) = (self.newer[index as usize], self.older[index as usize]);
        match newer {
            NOWHERE => self.newest = older,
            newer => self.older[newer as usize] = older,
        }
        match older {
            NOWHERE => self.oldest = newer,
            older => self.newer[older as usize] = newer,
        }
    }

    fn link_newest(&mut self, index: u32) {
        self.newer[index as usize] = NOWHERE;
        self.older[index as usize] = self.newest;
        match self.newest {
            NOWHERE => self.oldest = index,
            newest => self.newer[newest as usize] = index,
        }
        self.newest = index;
    }
}
