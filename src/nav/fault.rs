//! Interface for injecting faults between the navigation sources and the history.

use echotank_core::navigation::NavSample;
use echotank_core::time::UtcNs;

/// Injector of faults into navigation samples and into the received bytes of live sources.
pub trait NavFaultFilter: Send {
    /// Modifies the bytes that a live source received, before they are decoded. `source` is the index of the source.
    fn modify_bytes(&mut self, source: usize, arrival: UtcNs, bytes: &mut Vec<u8>) {
        let _ = (source, arrival, bytes);
    }

    /// Returns the sample, modified or not. `None` drops or delays the sample.
    fn modify_sample(&mut self, sample: NavSample) -> Option<NavSample>;

    /// Returns the next delayed sample that is due by `until`, or `None`.
    fn take_delayed(&mut self, until: UtcNs) -> Option<NavSample>;
}
