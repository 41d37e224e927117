//! Distributes frames from the pings to the open pages, through bounded queues. A short history serves pages opened later.
//!
//! Delivery threads publish [`Frame`]s and never wait. A page that does not read, such as a hidden window, misses the oldest frames, which are
//! counted. [`super::frame`] defines the content of a frame.

use std::collections::{BTreeMap, VecDeque};
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use axum::body::Bytes;
use serde::Deserialize;
use tokio::sync::broadcast;

use super::frame::Kind;

/// Pings kept for each sonar, for new pages: 2.5 minutes at 4 pings/s, about 2 MB of lines and 2 MB of soundings of 256 beams.
pub(crate) const HISTORY_PINGS: usize = 600;
/// Maximum number of frames queued for the slowest page: a few seconds of a sonar with a fan.
const QUEUE_FRAMES: usize = 64;
/// Maximum number of different rows of samples taken from one ping for all pages together.
pub(crate) const MAX_SCOPES: usize = 8;

/// A row of samples that a page displays.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scope {
    /// Kind of row.
    pub of: ScopeOf,
    /// Index of the receive array, fan or line.
    #[serde(default)]
    pub array: u16,
    /// Index of the element or beam.
    #[serde(default)]
    pub index: u16,
    /// Index of the first sample displayed.
    #[serde(default)]
    pub first: u32,
}

/// Kind of a row of samples.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ScopeOf {
    /// Samples of an element.
    Element,
    /// Samples of a beam.
    Beam,
    /// Samples of a side-scan line.
    Line,
}

/// Data that one page displays.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Want {
    /// Index of the sonar in the configuration.
    pub sonar: u16,
    /// The fan of beams.
    pub fan: bool,
    /// Levels of the elements.
    pub elements: bool,
    /// A row of samples.
    pub scope: Option<Scope>,
}

impl Want {
    /// Whether the page needs a frame.
    pub fn takes(&self, frame: &Frame) -> bool {
        self.sonar == frame.sonar
            && match frame.kind {
                Kind::Line | Kind::Soundings => true,
                Kind::Fan => self.fan,
                Kind::Elements => self.elements,
                Kind::Scope => frame.scope == self.scope,
                Kind::Relief => false,
            }
    }
}

/// Data that all pages together need from the next ping of one sonar.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct PageDemand {
    /// The fan of beams.
    pub fan: bool,
    /// Levels of the elements.
    pub elements: bool,
    pub(crate) scopes: Vec<Scope>,
}

/// An encoded frame, shared by all pages.
#[derive(Debug)]
pub struct Frame {
    /// Index of the sonar in the configuration.
    pub sonar: u16,
    /// Content of the frame.
    pub kind: Kind,
    /// Row of samples, for a frame of samples.
    pub scope: Option<Scope>,
    /// Encoded frame, see [`super::frame`].
    pub bytes: Bytes,
}

/// The channel from the pings to the pages.
pub struct Feed {
    frames: broadcast::Sender<Arc<Frame>>,
    /// Recent lines and soundings per sonar.
    history: Mutex<Vec<History>>,
    /// Selection of each page by page number; `None` until the page has chosen.
    wants: Mutex<BTreeMap<u64, Option<Want>>>,
    next_page: AtomicU64,
    /// Number of `wants`; 0 avoids the lock.
    pages: AtomicUsize,
    counts: Counts,
}

/// Recent frames of one sonar, oldest first.
struct History {
    lines: VecDeque<Arc<Frame>>,
    soundings: VecDeque<Arc<Frame>>,
}

impl History {
    /// Ring of a kind of frame that is kept.
    fn ring(&mut self, kind: Kind) -> Option<&mut VecDeque<Arc<Frame>>> {
        match kind {
            Kind::Line => Some(&mut self.lines),
            Kind::Soundings => Some(&mut self.soundings),
            Kind::Fan | Kind::Elements | Kind::Scope | Kind::Relief => None,
        }
    }
}

#[derive(Default)]
struct Counts {
    frames: AtomicU64,
    sent: AtomicU64,
    dropped: AtomicU64,
}

/// Counters of the feed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct FeedCounts {
    pub(crate) pages: usize,
    pub(crate) pages_ever: u64,
    /// Frames published.
    pub frames: u64,
    /// Frames sent, summed over the pages.
    pub sent: u64,
    /// Frames that a page missed.
    pub dropped: u64,
}

impl Feed {
    /// A feed for this number of sonars.
    pub fn new(sonars: usize) -> Self {
        let ring = || VecDeque::with_capacity(HISTORY_PINGS);
        let history = || History {
            lines: ring(),
            soundings: ring(),
        };
        Self {
            frames: broadcast::Sender::new(QUEUE_FRAMES),
            history: Mutex::new((0..sonars).map(|_| history()).collect()),
            wants: Mutex::default(),
            next_page: AtomicU64::new(0),
            pages: AtomicUsize::new(0),
            counts: Counts::default(),
        }
    }

    /// Whether a page is open.
    pub(crate) fn is_watched(&self) -> bool {
        self.pages.load(Ordering::Acquire) > 0
    }

    /// Returns the data that the pages need from the next ping of a sonar.
    pub fn wanted(&self, sonar: u16) -> PageDemand {
        let mut wanted = PageDemand::default();
        if !self.is_watched() {
            return wanted;
        }
        let wants = lock(&self.wants);
        for want in wants.values().flatten().filter(|w| w.sonar == sonar) {
            wanted.fan |= want.fan;
            wanted.elements |= want.elements;
            if let Some(scope) = want.scope
                && wanted.scopes.len() < MAX_SCOPES
                && !wanted.scopes.contains(&scope)
            {
                wanted.scopes.push(scope);
            }
        }
        wanted
    }

    /// Passes a frame to every page; never waits.
    pub fn publish(&self, frame: Frame) {
        let frame = Arc::new(frame);
        self.counts.frames.fetch_add(1, Ordering::Relaxed);
        let mut history = lock(&self.history);
        let of_sonar = history.get_mut(usize::from(frame.sonar));
        if let Some(ring) = of_sonar.and_then(|history| history.ring(frame.kind)) {
            if ring.len() == HISTORY_PINGS {
                ring.pop_front();
            }
            ring.push_back(Arc::clone(&frame));
        }
        // The lock on the history makes a new page get this frame exactly once. Sending fails when no page is open.
        let _ = self.frames.send(frame);
    }

    /// Registers a new page.
    pub fn join(self: &Arc<Self>) -> Page {
        let id = self.next_page.fetch_add(1, Ordering::Relaxed);
        let mut wants = lock(&self.wants);
        wants.insert(id, None);
        self.pages.store(wants.len(), Ordering::Release);
        drop(wants);
        Page {
            feed: Arc::clone(self),
            id,
            want: None,
            frames: self.frames.subscribe(),
        }
    }

    /// Counters so far.
    pub fn counts(&self) -> FeedCounts {
        let read = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        FeedCounts {
            pages: self.pages.load(Ordering::Acquire),
            pages_ever: read(&self.next_page),
            frames: read(&self.counts.frames),
            sent: read(&self.counts.sent),
            dropped: read(&self.counts.dropped),
        }
    }
}

/// Receiving end of an open page.
pub struct Page {
    feed: Arc<Feed>,
    id: u64,
    want: Option<Want>,
    frames: broadcast::Receiver<Arc<Frame>>,
}

/// Next event for a page.
pub enum Next {
    /// A frame to send.
    Frame(Arc<Frame>),
    /// The page missed this many frames.
    Dropped(u64),
    /// The feed has ended.
    End,
}

impl Page {
    /// Changes what the page displays. Returns the recent lines and soundings if the sonar changes or this is the first choice.
    pub fn look(&mut self, want: Want) -> Vec<Arc<Frame>> {
        let before = self.want.replace(want);
        lock(&self.feed.wants).insert(self.id, self.want);
        if before.is_some_and(|before| before.sonar == want.sonar) {
            return Vec::new();
        }
        let history = lock(&self.feed.history);
        self.frames = self.feed.frames.subscribe();
        let Some(history) = history.get(usize::from(want.sonar)) else {
            return Vec::new();
        };
        let frames = history.lines.iter().chain(&history.soundings);
        frames.cloned().collect()
    }

    /// Waits for the next frame that the page needs.
    pub async fn next(&mut self) -> Next {
        loop {
            match self.frames.recv().await {
                Ok(frame) if self.want.is_some_and(|want| want.takes(&frame)) => {
                    return Next::Frame(frame);
                }
                Ok(_) => {}
                Err(broadcast::error::RecvError::Lagged(n)) => {
                    self.feed.counts.dropped.fetch_add(n, Ordering::Relaxed);
                    return Next::Dropped(n);
                }
                Err(broadcast::error::RecvError::Closed) => return Next::End,
            }
        }
    }

    /// Counts a frame as sent.
    pub fn sent(&self) {
        self.feed.counts.sent.fetch_add(1, Ordering::Relaxed);
    }
}

impl Drop for Page {
    fn drop(&mut self) {
        let mut wants = lock(&self.feed.wants);
        wants.remove(&self.id);
        self.feed.pages.store(wants.len(), Ordering::Release);
    }
}

/// Every statement under these locks leaves consistent data.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(kind: Kind, ping: u8) -> Frame {
        Frame {
            sonar: 0,
            kind,
            scope: None,
            bytes: Bytes::copy_from_slice(&[ping]),
        }
    }

    fn runtime() -> tokio::runtime::Runtime {
        let mut builder = tokio::runtime::Builder::new_current_thread();
        builder.build().expect("a runtime")
    }

    #[test]
    fn a_page_that_sleeps_misses_the_oldest_frames_and_they_are_counted() {
        let feed = Arc::new(Feed::new(1));
        let mut page = feed.join();
        page.look(Want::default());
        for ping in 0..(QUEUE_FRAMES as u8 + 10) {
            feed.publish(frame(Kind::Line, ping));
        }
        let mut got = Vec::new();
        let mut dropped = 0;
        runtime().block_on(async {
            while got.len() < QUEUE_FRAMES {
                match page.next().await {
                    Next::Frame(frame) => got.push(frame.bytes[0]),
                    Next::Dropped(n) => dropped += n,
                    Next::End => break,
                }
            }
        });
        assert_eq!(dropped, 10);
        assert_eq!(got, (10..QUEUE_FRAMES as u8 + 10).collect::<Vec<_>>());
        assert_eq!(feed.counts().dropped, 10);
    }

    #[test]
    fn who_comes_later_gets_the_history_and_then_every_line_once() {
        let feed = Arc::new(Feed::new(1));
        for ping in 0..5 {
            feed.publish(frame(Kind::Line, ping));
            feed.publish(frame(Kind::Fan, ping));
            feed.publish(frame(Kind::Soundings, 100 + ping));
        }
        let mut page = feed.join();
        let before = page.look(Want::default());
        feed.publish(frame(Kind::Line, 5));
        let mut seen: Vec<_> = before.iter().map(|f| f.bytes[0]).collect();
        if let Next::Frame(frame) = runtime().block_on(page.next()) {
            seen.push(frame.bytes[0]);
        }
        assert_eq!(seen, [0, 1, 2, 3, 4, 100, 101, 102, 103, 104, 5]);
    }

    #[test]
    fn nothing_is_wanted_without_a_page_and_only_so_many_scopes_with_many() {
        let feed = Arc::new(Feed::new(2));
        assert_eq!(feed.wanted(0), PageDemand::default());
        let mut pages: Vec<_> = (0..20).map(|_| feed.join()).collect();
        for (index, page) in pages.iter_mut().enumerate() {
            page.look(Want {
                sonar: 1,
                fan: index == 3,
                elements: false,
                scope: Some(Scope {
                    of: ScopeOf::Element,
                    array: 0,
                    index: index as u16 / 2,
                    first: 0,
                }),
            });
        }
        assert_eq!(feed.wanted(0), PageDemand::default());
        let wanted = feed.wanted(1);
        assert!(wanted.fan && !wanted.elements);
        assert_eq!(wanted.scopes.len(), MAX_SCOPES);
        assert_eq!(feed.counts().pages, 20);
        drop(pages);
        assert!(!feed.is_watched());
        assert_eq!(feed.wanted(1), PageDemand::default());
    }

    #[test]
    fn the_history_is_bounded() {
        let feed = Arc::new(Feed::new(1));
        for ping in 0..HISTORY_PINGS + 7 {
            feed.publish(frame(Kind::Line, (ping % 251) as u8));
            feed.publish(frame(Kind::Soundings, (ping % 251) as u8));
        }
        let frames = feed.join().look(Want::default());
        assert_eq!(frames.len(), 2 * HISTORY_PINGS);
        assert_eq!(frames[0].bytes[0], 7);
        assert_eq!(frames[HISTORY_PINGS].bytes[0], 7);
    }
}
