//! Tiles kept for the next ping, within a bound; the one not used for longest makes room.

use std::collections::HashMap;
use std::sync::{Mutex, MutexGuard, PoisonError};

use super::tiles::{Recipe, Tile, TileId};

/// None, in the chain of slots.
const NO_SLOT: u32 = u32::MAX;

/// A slot in the pool that a ping was given.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Slot {
    pub id: TileId,
    index: u32,
    /// What stands there is another tile: this one must be made.
    pub stale: bool,
}

/// Allocates while it grows to its capacity, and not after.
#[derive(Debug)]
pub(crate) struct TilePool {
    capacity: usize,
    slot_of: HashMap<TileId, u32>,
    ids: Vec<TileId>,
    /// Each tile is worked on by one thread at a time: no lock ever waits.
    tiles: Vec<Mutex<Tile>>,
    /// Chain from the slot used last to the one not used for longest.
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
            capacity: capacity.min(NO_SLOT as usize),
            slot_of: HashMap::new(),
            ids: Vec::new(),
            tiles: Vec::new(),
            newer: Vec::new(),
            older: Vec::new(),
            newest: NO_SLOT,
            oldest: NO_SLOT,
        }
    }

    pub(crate) fn capacity(&self) -> usize {
        self.capacity
    }

    /// Gives each of the tiles a slot, at most as many as there is room for and none twice.
    pub(crate) fn slots(
        &mut self,
        ids: impl ExactSizeIterator<Item = TileId>,
        out: &mut Vec<Slot>,
    ) {
        assert!(ids.len() <= self.capacity, "more tiles than room");
        out.clear();
        // First those that are there, so that none of them makes room for another.
        for id in ids {
            let index = self.slot_of.get(&id).copied();
            if let Some(index) = index {
                self.unlink(index);
                self.link_newest(index);
            }
            out.push(Slot {
                id,
                index: index.unwrap_or(NO_SLOT),
                stale: index.is_none(),
            });
        }
        for slot in out.iter_mut().filter(|p| p.stale) {
            slot.index = self.vacate();
            self.ids[slot.index as usize] = slot.id;
            self.slot_of.insert(slot.id, slot.index);
            self.link_newest(slot.index);
        }
    }

    /// Works on the tile of a slot, made first where it was not there. To be called once for each slot before any is called again.
    pub(crate) fn work<T>(
        &self,
        slot: &Slot,
        recipe: &Recipe,
        work: impl FnOnce(&mut Tile) -> T,
    ) -> T {
        let mut tile = self.tile(slot);
        if slot.stale {
            recipe.make(slot.id, &mut tile);
        }
        work(&mut tile)
    }

    /// Reads a tile that was worked on.
    pub(crate) fn read<T>(&self, slot: &Slot, read: impl FnOnce(&Tile) -> T) -> T {
        read(&self.tile(slot))
    }

    fn tile(&self, slot: &Slot) -> MutexGuard<'_, Tile> {
        // Whoever panicked while he held the lock took his ping with him; the lock itself is sound.
        self.tiles[slot.index as usize]
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }

    /// A slot that is in no chain: a new one, or that of the tile not used for longest.
    fn vacate(&mut self) -> u32 {
        if self.tiles.len() < self.capacity {
            let index = self.tiles.len() as u32;
            // An index at most half full tidies itself up in slot, however often tiles come and go.
            self.slot_of.reserve(self.tiles.len() + 2);
            self.ids.push(TileId {
                level: 0,
                row: 0,
                col: 0,
            });
            self.tiles.push(Mutex::new(Tile::with_room()));
            self.newer.push(NO_SLOT);
            self.older.push(NO_SLOT);
            return index;
        }
        let index = self.oldest;
        self.unlink(index);
        self.slot_of.remove(&self.ids[index as usize]);
        index
    }

    fn unlink(&mut self, index: u32) {
        let (newer, older) = (self.newer[index as usize], self.older[index as usize]);
        match newer {
            NO_SLOT => self.newest = older,
            newer => self.older[newer as usize] = older,
        }
        match older {
            NO_SLOT => self.oldest = newer,
            older => self.newer[older as usize] = newer,
        }
    }

    fn link_newest(&mut self, index: u32) {
        self.newer[index as usize] = NO_SLOT;
        self.older[index as usize] = self.newest;
        match self.newest {
            NO_SLOT => self.oldest = index,
            newest => self.newer[newest as usize] = index,
        }
        self.newest = index;
    }
}
