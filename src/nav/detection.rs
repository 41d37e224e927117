//! Detects the quantities of recorded logs without a configured `provides`, and names the source of each quantity.
//!
//! A log provides a quantity if its samples cover at least [`MIN_SHARE`] of the time with positions. A quantity with less coverage
//! would leave pings without navigation, so it is excluded with a warning. The best source of a quantity that every ping needs is
//! not excluded.

use crate::history::MAX_GAP_S;
use echotank_config::spec::{NavChannel, NavInputSpec, NavSpec, VerticalSpec};
use echotank_core::navigation::NavSample;
use echotank_core::time::UtcNs;
use thiserror::Error;

/// Minimum fraction of the time with positions that the samples of a quantity must cover.
const MIN_SHARE: f64 = 0.5;

/// Error: every ping needs a quantity that no log provides.
#[derive(Debug, Error, PartialEq, Eq)]
#[error("no source gives a {what}: {held}; {remedy}")]
pub struct MissingQuantity {
    what: &'static str,
    /// Text that lists the quantities of the logs.
    held: String,
    remedy: &'static str,
}

/// Time covered by the samples of a channel, seconds: the sum of the steps that are short enough for interpolation.
fn covered_s(samples: &[NavSample], channel: NavChannel) -> f64 {
    let of = samples
        .iter()
        .filter(|s| NavChannel::of(&s.quantity) == channel);
    let mut times: Vec<UtcNs> = of.map(|s| s.valid_utc).collect();
    times.sort();
    let steps = times.windows(2).map(|w| w[1].seconds_since(w[0]));
    steps
        .filter(|step_s| *step_s <= MAX_GAP_S)
        .fold(0.0, |sum, step_s| sum + step_s)
}

/// Sets `provides` of the recorded logs that leave it open, from the samples of each source in `samples`.
///
/// Returns a warning for each quantity that is excluded, replaced or missing. Returns an error if all sources are files and no
/// source provides a quantity that every ping needs.
pub fn detect(
    spec: &mut NavSpec,
    samples: &[Vec<NavSample>],
) -> Result<Vec<String>, MissingQuantity> {
    let is_open = |spec: &NavSpec, i: usize| {
        let source = &spec.sources[i];
        source.detect && source.is_recorded()
    };
    if !(0..spec.sources.len()).any(|i| is_open(spec, i)) {
        return Ok(Vec::new());
    }
    let covered: Vec<_> = samples
        .iter()
        .map(|samples| NavChannel::ALL.map(|channel| covered_s(samples, channel)))
        .collect();
    let longest_s = |channel: NavChannel| {
        let seconds = covered.iter().map(|s| s[channel as usize]);
        seconds.fold(0.0, f64::max)
    };
    let whole_s = match longest_s(NavChannel::Position) {
        0.0 => NavChannel::ALL
            .map(longest_s)
            .into_iter()
            .fold(0.0, f64::max),
        whole_s => whole_s,
    };
    let needs_heading = !spec.is_recorded() || spec.heading_from_course == Some(false);
    let holds = |i: usize, channel: NavChannel| {
        let mut samples = samples[i].iter();
        samples.any(|s| NavChannel::of(&s.quantity) == channel)
    };
    let gives = |i: usize, channel: NavChannel| {
        let seconds = covered[i][channel as usize];
        let is_needed = match channel {
            NavChannel::Position => true,
            NavChannel::Heading => needs_heading,
            _ => false,
        };
        let is_best = is_needed && seconds >= longest_s(channel);
        holds(i, channel) && (is_best || seconds >= MIN_SHARE * whole_s)
    };
    let mut warnings = Vec::new();
    for (i, seconds) in covered.iter().enumerate() {
        if !is_open(spec, i) {
            continue;
        }
        let source = &mut spec.sources[i];
        source.detect = false;
        source.provides.retain(|&channel| gives(i, channel));
        for channel in NavChannel::ALL {
            if holds(i, channel) && !source.provides.contains(&channel) {
                warnings.push(format!(
                    "{} gives {} for {:.0} s of {whole_s:.0} s: not used; `provides` would select it",
                    source.name,
                    channel.name(),
                    seconds[channel as usize]
                ));
            }
        }
        if source.provides.is_empty() {
            warnings.push(format!("{} gives nothing that is used", source.name));
        }
    }
    if spec.is_recorded() {
        refuse_or_replace_missing(spec, &mut warnings)?;
    }
    Ok(warnings)
}

/// Replaces a quantity that no file provides, or refuses the configuration if there is no replacement.
fn refuse_or_replace_missing(
    spec: &mut NavSpec,
    warnings: &mut Vec<String>,
) -> Result<(), MissingQuantity> {
    let held = holdings(spec);
    let missing = |what, remedy| Err(MissingQuantity { what, held, remedy });
    let Some(positions) = owner(spec, NavChannel::Position) else {
        return missing("position", "add a source that does");
    };
    let is_track = matches!(spec.sources[positions].input, NavInputSpec::Csv { .. });
    if spec.vertical == VerticalSpec::Depth && owner(spec, NavChannel::Depth).is_none() {
        if !is_track {
            let remedy = "add a source that does, or set nav.vertical";
            return missing("depth, which nav.vertical = \"depth\" needs", remedy);
        }
        // The heave of a track is its displacement from depth 0.
        spec.heave_from_depth_m = spec.heave_from_depth_m.or(Some(0.0));
    }
    if owner(spec, NavChannel::Heading).is_none() {
        if spec.heading_from_course == Some(false) {
            let remedy = "add a source that does, or set nav.heading_from_course = true";
            return missing("heading", remedy);
        }
        if spec.heading_from_course.is_none() {
            warnings.push(
                "no source gives a heading: the course over ground is used, which is random at rest (nav.heading_from_course)"
                    .to_owned(),
            );
        }
        spec.heading_from_course = Some(true);
    }
    let lacks = |channel| owner(spec, channel).is_none();
    if lacks(NavChannel::RollPitch) {
        warnings.push("no source gives roll and pitch: the platform stays level".to_owned());
    }
    if lacks(NavChannel::Heave) && matches!(spec.vertical, VerticalSpec::Waterline { .. }) {
        warnings.push("no source gives heave: the platform does not heave".to_owned());
    }
    Ok(())
}

/// The first source that provides a quantity.
fn owner(spec: &NavSpec, channel: NavChannel) -> Option<usize> {
    let mut sources = spec.sources.iter();
    sources.position(|s| s.provides.contains(&channel))
}

/// Text with the quantities of each source.
fn holdings(spec: &NavSpec) -> String {
    let of = |s: &echotank_config::spec::NavSourceSpec| {
        let names: Vec<_> = s.provides.iter().map(|c| c.name()).collect();
        match names.is_empty() {
            true => format!("{} gives nothing", s.name),
            false => format!("{} gives {}", s.name, names.join(", ")),
        }
    };
    let all: Vec<_> = spec.sources.iter().map(of).collect();
    all.join("; ")
}

/// Text with the source of each quantity: `position from gnss, heading from gyro`.
///
/// `active` gives the index of the source of a quantity.
pub fn owners_text(spec: &NavSpec, active: impl Fn(NavChannel) -> Option<u16>) -> String {
    let from = |channel: NavChannel| {
        let source = spec.sources.get(usize::from(active(channel)?))?;
        Some(format!("{} from {}", channel.name(), source.name))
    };
    let all: Vec<_> = NavChannel::ALL.into_iter().filter_map(from).collect();
    match all.is_empty() {
        true => "none".to_owned(),
        false => all.join(", "),
    }
}
