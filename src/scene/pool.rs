//! Cache of tiles with a bounded size. The least recently used tile is replaced where the cache is full, or where no ping has used it for a while: a
//! platform that moves on then needs little memory, which it does not have to ask for.

use std::collections::HashMap;
use std::sync::{Mutex, MutexGuard, PoisonError};

use super::tiles::{Recipe, Tile, TileId};

/// End of the list of slots.
const NO_SLOT: u32 = u32::MAX;

/// The pool grows while each of its tiles is among those of so many of the last requests.
const REQUESTS_IN_USE: u64 = 16;

/// A slot of the pool that a ping uses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Slot {
    pub id: TileId,
    index: u32,
    /// The slot holds another tile; this one must be made.
    pub stale: bool,
}

/// Pool of tiles. It allocates while it grows to its capacity, and not after.
#[derive(Debug)]
pub(crate) struct TilePool {
    capacity: usize,
    slot_of: HashMap<TileId, u32>,
    ids: Vec<TileId>,
    /// Number of requests so far, and that of the last request of each slot.
    requests: u64,
    requested: Vec<u64>,
    /// One thread at a time works on a tile, so no lock ever waits.
    tiles: Vec<Mutex<Tile>>,
    /// Doubly linked list from the most to the least recently used slot.
    newer: Vec<u32>,
    older: Vec<u32>,
    newest: u32,
    oldest: u32,
}

impl TilePool {
    /// A pool of `capacity` tiles, at least one.
    pub(crate) fn new(capacity: usize) -> Self {
        assert!(capacity > 0, "a pool without room");
        Self {
            capacity: capacity.min(NO_SLOT as usize),
            slot_of: HashMap::new(),
            ids: Vec::new(),
            requests: 0,
            requested: Vec::new(),
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

    /// Number of tiles in memory.
    #[cfg(test)]
    pub(crate) fn len(&self) -> usize {
        self.tiles.len()
    }

    /// Assigns a slot to each tile. `ids` holds at most [`Self::capacity`] tiles, none twice.
    pub(crate) fn slots(
        &mut self,
        ids: impl ExactSizeIterator<Item = TileId>,
        out: &mut Vec<Slot>,
    ) {
        assert!(ids.len() <= self.capacity, "more tiles than room");
        out.clear();
        self.requests += 1;
        // Present tiles come first, so that none of them is replaced.
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

    /// Runs `work` on the tile of a slot, and starts the tile first if the slot is stale. Call it once for each slot before calling it again for any.
    pub(crate) fn work<T>(
        &self,
        slot: &Slot,
        recipe: &Recipe,
        work: impl FnOnce(&mut Tile) -> T,
    ) -> T {
        let mut tile = self.tile(slot);
        if slot.stale {
            recipe.start(slot.id, &mut tile);
        }
        work(&mut tile)
    }

    /// Runs `read` on a tile that [`Self::work`] has started.
    pub(crate) fn read<T>(&self, slot: &Slot, read: impl FnOnce(&Tile) -> T) -> T {
        read(&self.tile(slot))
    }

    fn tile(&self, slot: &Slot) -> MutexGuard<'_, Tile> {
        // A panic under the lock ends its ping; the tile itself stays valid.
        self.tiles[slot.index as usize]
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }

    /// An unlinked slot: a new one, or that of the least recently used tile.
    fn vacate(&mut self) -> u32 {
        let last_request = self.requested.get(self.oldest as usize);
        let in_use = last_request.is_none_or(|last| self.requests - last <= REQUESTS_IN_USE);
        if in_use && self.tiles.len() < self.capacity {
            let index = self.tiles.len() as u32;
            // A map that is at most half full rehashes in place, however often entries come and go.
            self.slot_of.reserve(self.tiles.len() + 2);
            self.ids.push(TileId {
                level: 0,
                row: 0,
                col: 0,
            });
            // Whoever makes the tile allocates its memory, all threads at once.
            self.tiles.push(Mutex::new(Tile::without_room()));
            self.requested.push(0);
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
        self.requested[index as usize] = self.requests;
        self.newer[index as usize] = NO_SLOT;
        self.older[index as usize] = self.newest;
        match self.newest {
            NO_SLOT => self.oldest = index,
            newest => self.newer[newest as usize] = index,
        }
        self.newest = index;
    }
}
