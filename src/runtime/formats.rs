//! File formats and options of a replay.

use std::path::PathBuf;

/// File formats that a replay writes.
#[derive(Clone, Copy, Debug, Default)]
pub struct Formats {
    /// Teledyne RESON 7k records.
    pub s7k: bool,
    /// EdgeTech JSF messages.
    pub jsf: bool,
    /// Triton XTF packets.
    pub xtf: bool,
    /// NumPy archives of element samples, one per ping.
    pub npz: bool,
    /// Side-scan waterfall pictures.
    pub png: bool,
    /// Synthetic-aperture images, for the sonars with a synthetic aperture configured.
    pub sas: bool,
    /// Fan pictures of the first ping's beams.
    pub fan: bool,
    /// Side-scan mosaics.
    pub mosaic: bool,
    /// Target and shadow masks beside the waterfall.
    pub masks: bool,
    /// SigMF recordings of element samples.
    pub sigmf: bool,
    /// WAV recordings of element samples.
    pub wav: bool,
}

impl Formats {
    /// Name of the first requested format that needs element samples.
    pub(crate) fn of_elements(&self) -> Option<&'static str> {
        let all = [
            (self.s7k, "s7k"),
            (self.jsf, "jsf"),
            (self.npz, "npz"),
            (self.sas, "sas"),
            (self.sigmf, "sigmf"),
            (self.wav, "wav"),
        ];
        all.into_iter()
            .find(|(asked, _)| *asked)
            .map(|(_, name)| name)
    }
}

/// Options of a replay.
#[derive(Clone, Debug)]
pub struct ReplayOptions {
    /// Folder of the output files.
    pub out: PathBuf,
    /// File formats to write.
    pub formats: Formats,
    /// Whether `.npz` samples are complex128 instead of complex64.
    pub f64: bool,
    /// First and last ping number, both included. `None` replays the whole log once, even if the configuration loops it.
    pub pings: Option<(u32, u32)>,
    /// Number of compute threads; 0 means one per core.
    pub threads: usize,
}
