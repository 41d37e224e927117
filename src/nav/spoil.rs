//! Where navigation may go wrong: every sample passes here on its way from its source to the history, and what live sources say before that.

use echotank_core::flow::NavSample;
use echotank_core::time::UtcNs;

pub trait Spoil: Send {
    /// Bytes that a live source has said, before they are decoded.
    fn bytes(&mut self, source: usize, arrival: UtcNs, bytes: &mut Vec<u8>) {
        let _ = (source, arrival, bytes);
    }
    /// What becomes of a sample: another, itself, or none now.
    fn sample(&mut self, sample: NavSample) -> Option<NavSample>;
    /// One that was held back and has arrived by `until`; to be asked until there is none.
    fn held_back(&mut self, until: UtcNs) -> Option<NavSample>;
}
