//! Checks the side-scan formats JSF, XTF and Imagenex 872.

use super::super::spec::*;
use super::arrays::Arrays;
use super::{Listener, listen};
use crate::keys;
use crate::raw::{Entry, Problems};

/// Maximum number of JSF channels: the channel field has 8 bits.
const MAX_JSF_CHANNELS: usize = 256;
/// Maximum number of JSF samples: the sample count has 20 bits.
const MAX_JSF_SAMPLES: f64 = ((1 << 20) - 1) as f64;

/// Properties of the sonar that side-scan outputs depend on.
pub(super) struct Sonar<'a> {
    pub arrays: &'a Arrays<'a>,
    /// Number of samples of the longest ping.
    pub samples: Option<f64>,
    pub has_lines: bool,
    /// Number of further pulses in the water together with the first.
    pub more_pulses: usize,
}

fn needs_lines(key: &Entry, sonar: &Sonar<'_>, problems: &mut Problems) {
    if !sonar.has_lines {
        let rule = "needs side-scan lines: beams.port, beams.starboard or both";
        problems.refuse(key, rule);
    }
}

pub(super) fn jsf<'t>(
    table: &'t keys::families::Jsf,
    sonar: &Sonar<'_>,
    listeners: &mut Vec<Listener<'t>>,
    problems: &mut Problems,
) -> Option<JsfSpec> {
    let commands = listen(&table.listen, "TCP", listeners, problems);
    let data = listen(&table.listen_data, "TCP", listeners, problems);
    let staves = table.channels.is("staves");
    if staves == Some(false) {
        needs_lines(&table.channels, sonar, problems);
    }
    let arrays = sonar.arrays.chosen(&table.arrays, problems);
    if let (Some(true), Some(arrays)) = (staves, &arrays) {
        let specs = arrays.iter().filter_map(|&a| sonar.arrays.specs.get(a));
        let elements: usize = specs.flatten().map(|array| array.elements).sum();
        if elements > MAX_JSF_CHANNELS {
            let rule =
                format!("{elements} elements; JSF allows at most {MAX_JSF_CHANNELS} channels");
            problems.refuse(&table.arrays, rule);
        }
    }
    if (sonar.samples).is_some_and(|samples| samples > MAX_JSF_SAMPLES) {
        let rule = format!("a ping has more than {MAX_JSF_SAMPLES} samples, the maximum of JSF");
        problems.refuse(&table.format, rule);
    }
    let silent: Option<u8> = (table.silent_subsystem).given_and_then(|&s| s.try_into().ok())?;
    let subsystem = table.subsystem.to()?;
    if staves == Some(false) && table.format.text() == Some("envelope") {
        let last = usize::from(subsystem) + sonar.more_pulses;
        if last > usize::from(u8::MAX) {
            let rule = format!(
                "each pulse is a subsystem, and the last would be {last}; JSF allows at most 255"
            );
            problems.refuse(&table.subsystem, rule);
        }
        let its = usize::from(subsystem)..=last;
        if silent.is_some_and(|silent| its.contains(&silent.into())) {
            let rule =
                format!("is one of the sonar's own, {subsystem} to {last}: each pulse is one");
            problems.refuse(&table.silent_subsystem, rule);
        }
    }
    Some(JsfSpec {
        listen: commands?,
        listen_data: data?,
        subsystem,
        silent_subsystems: silent.into_iter().collect(),
        channels: table.channels.named()?,
        arrays: arrays?,
        format: table.format.named()?,
        record: table.record.get()?,
        client_queue_bytes: table.client_queue_mib.to()?,
        max_clients: table.max_clients.to()?,
    })
}

pub(super) fn xtf(
    table: &keys::families::Xtf,
    sonar: &Sonar<'_>,
    problems: &mut Problems,
) -> Option<XtfSpec> {
    needs_lines(&table.samples, sonar, problems);
    Some(XtfSpec {
        is_float: table.samples.text()? == "f32",
    })
}

pub(super) fn imagenex872<'t>(
    table: &'t keys::families::Imagenex872,
    sonar: &Sonar<'_>,
    listeners: &mut Vec<Listener<'t>>,
    problems: &mut Problems,
) -> Option<ImagenexSpec> {
    needs_lines(&table.listen, sonar, problems);
    Some(ImagenexSpec {
        listen: listen(&table.listen, "TCP", listeners, problems)?,
        client_queue_bytes: table.client_queue_mib.to()?,
        max_clients: table.max_clients.to()?,
    })
}
