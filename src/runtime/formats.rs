//! File formats and options of a replay.

use std::path::PathBuf;

use echotank_config::spec::{RigSpec, SonarSpec};

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
    /// Zarr stores of the same arrays.
    pub zarr: bool,
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
    /// MCAP recordings with ROS 2 messages.
    pub mcap: bool,
    /// SigMF recordings of element samples.
    pub sigmf: bool,
    /// WAV recordings of element samples.
    pub wav: bool,
}

impl Formats {
    /// The formats of a list of names, as `replay --formats` takes them.
    ///
    /// # Errors
    /// A name is unknown, or there is none.
    pub fn of_names(names: &[String]) -> Result<Self, String> {
        const NAMES: &str =
            "s7k, npz, zarr, jsf, xtf, png, sas, fan, mosaic, masks, sigmf, wav, mcap";
        let mut formats = Self::default();
        if names.is_empty() {
            return Err(format!("formats = []: must name at least one of {NAMES}"));
        }
        for name in names {
            let asked = match name.as_str() {
                "s7k" => &mut formats.s7k,
                "npz" => &mut formats.npz,
                "zarr" => &mut formats.zarr,
                "jsf" => &mut formats.jsf,
                "xtf" => &mut formats.xtf,
                "png" => &mut formats.png,
                "sas" => &mut formats.sas,
                "fan" => &mut formats.fan,
                "mosaic" => &mut formats.mosaic,
                "masks" => &mut formats.masks,
                "mcap" => &mut formats.mcap,
                "sigmf" => &mut formats.sigmf,
                "wav" => &mut formats.wav,
                _ => return Err(format!("formats: {name:?}: must be one of {NAMES}")),
            };
            *asked = true;
        }
        Ok(formats)
    }

    /// The first requested format that no sonar of a rig has data for: its name, and what the sonars lack.
    pub fn unfit(&self, rig: &RigSpec) -> Option<(&'static str, &'static str)> {
        const LINES: &str = "has side-scan lines: receive arrays named in sonar.beams.port and sonar.beams.starboard";
        let any = |has: fn(&SonarSpec) -> bool| rig.sonars.iter().any(has);
        let lines = any(|sonar| !sonar.beams.lines.is_empty());
        let fan = any(|sonar| sonar.beams.fan.is_some());
        let aperture = any(|sonar| sonar.beams.synthetic_aperture.is_some());
        let all = [
            (self.xtf && !lines, "xtf", LINES),
            (self.png && !lines, "png", LINES),
            (self.mosaic && !lines, "mosaic", LINES),
            (
                self.fan && !fan,
                "fan",
                "has a fan: a table [sonar.beams.fan]",
            ),
            (
                self.masks && !lines && !fan,
                "masks",
                "has side-scan lines or a fan, whose pictures the masks label",
            ),
            (
                self.sas && !aperture,
                "sas",
                "has a table [sonar.beams.synthetic_aperture]",
            ),
        ];
        let mut all = all.into_iter();
        all.find_map(|(unfit, name, lacks)| unfit.then_some((name, lacks)))
    }

    /// Name of the first requested format that needs element samples.
    pub(crate) fn of_elements(&self) -> Option<&'static str> {
        let all = [
            (self.s7k, "s7k"),
            (self.jsf, "jsf"),
            (self.npz, "npz"),
            (self.zarr, "zarr"),
            (self.sas, "sas"),
            (self.mcap, "mcap"),
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
