//! A log from the command line in place of the configured navigation sources.

use std::path::Path;

use echotank_config::spec::{NavChannel, NavInputSpec, NavSourceSpec, NavSpec};

/// Rate of the sentences of a log without any time, hertz. A live source has no such setting.
const PLAIN_RATE_HZ: f64 = 1.0;

/// Reads `log` in place of the first recorded source and of every live source. All quantities of the log are used.
///
/// The first of these sources reads the log for the others, except for quantities that another source lists with another lever arm or mounting:
/// that source reads them from the log. Sources of another format are left out, because the log cannot hold their bytes.
pub fn replace_sources(spec: &mut NavSpec, log: &Path) {
    let sources = std::mem::take(&mut spec.sources);
    let first_recorded = sources.iter().position(NavSourceSpec::is_recorded);
    let mut main: Option<usize> = None;
    let mut given_away: Vec<NavChannel> = Vec::new();
    for (i, source) in sources.into_iter().enumerate() {
        if source.is_recorded() && first_recorded != Some(i) {
            spec.sources.push(source);
        } else if let Some(first) = main.map(|at| &spec.sources[at]) {
            given_away.extend(own_quantities(&source, first, &given_away));
            let provides = own_quantities(&source, first, &[]);
            if !provides.is_empty() {
                spec.sources.push(NavSourceSpec {
                    provides,
                    detect: true,
                    ..reading(source, log)
                });
            }
        } else {
            main = Some(spec.sources.len());
            spec.sources.push(reading(source, log));
        }
    }
    if let Some(first) = main.map(|at| &mut spec.sources[at])
        && let NavInputSpec::Log { .. } = first.input
    {
        first.provides = NavChannel::ALL.to_vec();
        first
            .provides
            .retain(|channel| !given_away.contains(channel));
        first.detect = true;
    }
}

/// Quantities that `source` lists with another lever arm or mounting than `first`, which does not list them.
fn own_quantities(
    source: &NavSourceSpec,
    first: &NavSourceSpec,
    taken: &[NavChannel],
) -> Vec<NavChannel> {
    let is_alike = source.lever_arm_m == first.lever_arm_m && source.mounting == first.mounting;
    let is_track = matches!(first.input, NavInputSpec::Csv { .. });
    let is_other = is_track || source.dialect.format != first.dialect.format;
    if is_alike || is_other || source.detect {
        return Vec::new();
    }
    let mut own = source.provides.clone();
    own.retain(|c| (first.detect || !first.provides.contains(c)) && !taken.contains(c));
    own
}

fn reading(source: NavSourceSpec, log: &Path) -> NavSourceSpec {
    let input = match source.input {
        NavInputSpec::Csv { .. } => NavInputSpec::Csv { path: log.into() },
        NavInputSpec::Log { plain_rate_hz, .. } => NavInputSpec::Log {
            path: log.into(),
            plain_rate_hz,
        },
        _ => NavInputSpec::Log {
            path: log.into(),
            plain_rate_hz: PLAIN_RATE_HZ,
        },
    };
    NavSourceSpec { input, ..source }
}

#[cfg(test)]
mod tests {
    use super::*;
    use NavChannel::{Depth, Heading, Heave, Position, RollPitch};
    use echotank_config::AnyFiles;

    /// A rig with these tables of sources.
    fn nav(sources: &str) -> NavSpec {
        let text = include_str!("../../tests/data/config/minimal.toml");
        let source = "[[nav.source]]";
        let (head, rest) = text.split_once(source).expect("a source");
        let (_, tail) = rest.split_once("\n[").expect("another table");
        let text = format!("{head}{sources}\n[{tail}");
        let rig = echotank_config::parse(&text, Path::new("."), &AnyFiles);
        rig.unwrap_or_else(|e| panic!("{e}\n{text}")).nav
    }

    fn replaced(sources: &str) -> Vec<(String, Vec<NavChannel>)> {
        let mut spec = nav(sources);
        replace_sources(&mut spec, Path::new("new.log"));
        let reads = |s: &NavSourceSpec| match &s.input {
            NavInputSpec::Log { path, .. } | NavInputSpec::Csv { path } => {
                path == Path::new("new.log")
            }
            _ => panic!("{:?} is live", s.input),
        };
        let mut all = Vec::new();
        for source in &spec.sources {
            let provides = match reads(source) {
                true => source.provides.clone(),
                false => Vec::new(),
            };
            all.push((source.name.clone(), provides));
        }
        all
    }

    const GNSS: &str =
        "[[nav.source]]\nname = \"gnss\"\nkind = \"udp\"\nlisten = \"127.0.0.1:1\"\n";
    const BACKUP: &str =
        "[[nav.source]]\nname = \"backup\"\nkind = \"tcp\"\nconnect = \"10.0.0.1:2\"\n";
    const MRU: &str = "[[nav.source]]\nname = \"mru\"\nkind = \"serial\"\nport = \"/dev/ttyS0\"\nbaud = 9600\nprovides = [\"roll-pitch\", \"heave\"]\n";

    #[test]
    fn one_source_reads_the_log_for_all_live_sources() {
        let all = replaced(&format!("{GNSS}{BACKUP}{MRU}"));
        assert_eq!(all, [("gnss".to_owned(), NavChannel::ALL.to_vec())]);
    }

    #[test]
    fn a_sensor_at_another_place_keeps_its_quantities() {
        let all = replaced(&format!("{GNSS}{MRU}mounting_deg = [1.0, 0.0, 0.0]\n"));
        let rest = NavChannel::ALL.to_vec();
        let rest: Vec<_> = rest
            .into_iter()
            .filter(|c| ![RollPitch, Heave].contains(c))
            .collect();
        assert_eq!(
            all,
            [
                ("gnss".to_owned(), rest),
                ("mru".to_owned(), vec![RollPitch, Heave])
            ]
        );
    }

    #[test]
    fn the_first_log_is_replaced_with_the_live_sources_and_further_logs_stay() {
        let log = |name: &str, provides: &str| {
            format!(
                "[[nav.source]]\nname = \"{name}\"\nkind = \"log\"\npath = \"{name}.log\"\nprovides = {provides}\n"
            )
        };
        let old = log("old", "[\"position\", \"heading\"]");
        let all = replaced(&format!("{old}{}{BACKUP}", log("depth", "[\"depth\"]")));
        assert_eq!(
            all,
            [
                ("old".to_owned(), NavChannel::ALL.to_vec()),
                ("depth".to_owned(), vec![])
            ]
        );
        assert!(all[0].1.contains(&Position) && all[0].1.contains(&Depth));
        assert!(all[0].1.contains(&Heading));
    }
}
