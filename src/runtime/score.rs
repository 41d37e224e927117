//! A report laid beside the log of faults: which were found, which were not, and what was found that was never there.
//!
//! A finding explains a fault when its kind is what such a fault looks like from the other end of the line ([`looks_like`]) or the fault's own
//! name, and nothing that both say of where it was contradicts it. What follows from a fault besides (the record behind a cut one) is no
//! invention. A finding that does not say where counts for the first fault that it could be: such are counted apart.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use serde::{Deserialize, Serialize};

use crate::io::sonar::verification::report::{Finding, Report};

/// A line of `faults-*.jsonl`, as far as it is needed.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(default)]
pub struct Logged {
    pub fault: u32,
    pub kind: String,
    pub sonar: Option<String>,
    pub line: Option<String>,
    pub ping_number: u32,
    pub utc_ns: i64,
    pub source: Option<String>,
    pub quantity: Option<String>,
    pub record_type: Option<u32>,
    pub array: Option<usize>,
    pub element: Option<usize>,
    pub frame_number: Option<u32>,
    pub stream: Option<u32>,
    pub context: Option<bool>,
    pub packet_utc_ns: Option<i64>,
}

/// Reads a log; the number of the first line that is none, and why.
pub fn log_of(text: &str) -> Result<Vec<Logged>, (usize, String)> {
    let lines = text.lines().enumerate();
    let lines = lines.filter(|(_, line)| !line.trim().is_empty());
    lines
        .map(|(at, line)| serde_json::from_str(line).map_err(|why| (at + 1, why.to_string())))
        .collect()
}

/// What a kind of fault looks like from the other end of the line: the findings that show it, and those that may come of it besides, so many
/// pings later.
fn looks_like(kind: &str) -> (&'static [&'static str], &'static [&'static str], u32) {
    match kind {
        "drop" | "link-down" => (&["lost"], &["silent"], 0),
        "duplicate" => (&["duplicate"], &[], 0),
        "reorder" | "delay" | "jitter" => (&["late", "lost"], &[], 0),
        "corrupt" => (&["damaged", "different", "lost"], &[], 0),
        "corrupt-mended" => (&["different"], &[], 0),
        // A cut record takes the beginning of what follows on a connection for its own end.
        "truncate" => (
            &["damaged", "different", "lost"],
            &["damaged", "different", "lost"],
            1,
        ),
        // What was on its way is gone, and what comes until the client is back.
        "reset" => (&["reset"], &["lost", "silent"], 3),
        "half-open" => (&["silent"], &["lost"], 1),
        _ => (&[], &[], 0),
    }
}

fn shows(kind: &str, finding: &str) -> bool {
    kind == finding || looks_like(kind).0.contains(&finding)
}

/// Of one kind.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Tally {
    /// In the log and covered by the report. Of half-open connections: each silence is one.
    pub injected: u64,
    pub found: u64,
    /// By a finding that does not say where.
    pub found_by_count: u64,
    /// Held back, and so was what would have overtaken it: it came in order.
    pub masked: u64,
    pub missed: u64,
    /// The report says that this kind cannot be told.
    pub untold: u64,
    /// Records, pings or lines that the report does not cover.
    pub not_covered: u64,
}

#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Score {
    pub kinds: BTreeMap<String, Tally>,
    pub missed: Vec<String>,
    pub invented: Vec<Finding>,
    /// Findings that follow from a fault without being it.
    pub consequences: u64,
}

impl Score {
    /// Everything was found, and nothing else.
    pub fn is_clean(&self) -> bool {
        self.missed.is_empty() && self.invented.is_empty()
    }
}

/// One fault on trial: one injection, or a half-open connection's pings in a row.
struct Case<'a> {
    logged: &'a Logged,
    to_ping: u32,
    found: bool,
    by_count: bool,
    /// Not to be found: the report does not cover it or cannot tell it. What comes of it may be in the report all the same.
    is_aside: bool,
}

/// Lays a report beside a log.
pub fn score(log: &[Logged], report: &Report) -> Score {
    let mut score = Score::default();
    let mut cases = Vec::new();
    let mut seen_connections = BTreeSet::new();
    for logged in log {
        let tally = score.kinds.entry(logged.kind.clone()).or_default();
        let tells = report.head.tells.as_ref();
        let is_covered = covers(report, logged);
        let is_untold = is_covered && tells.is_some_and(|tells| !tells.contains(&logged.kind));
        tally.not_covered += u64::from(!is_covered);
        tally.untold += u64::from(is_untold);
        let is_aside = !is_covered || is_untold;
        if is_aside && !is_of_line(report, logged) {
            continue;
        }
        if !is_aside && matches!(logged.kind.as_str(), "reset" | "half-open") {
            // Every port of a family has its own line in the log.
            if !seen_connections.insert((logged.fault, logged.ping_number)) {
                continue;
            }
        }
        cases.push(Case {
            logged,
            to_ping: logged.ping_number,
            found: false,
            by_count: false,
            is_aside,
        });
    }
    join_silences(&mut cases);
    let index = Index::of(&cases);
    let mut unplaced = Vec::new();
    for finding in &report.findings {
        if !is_placed(finding) {
            unplaced.push(finding);
            continue;
        }
        let (mut explains, mut follows) = (false, false);
        for at in index.near(finding, &cases) {
            let case = &mut cases[at];
            if !case.is_aside && shows(&case.logged.kind, &finding.kind) && agree(case, finding, 0)
            {
                (case.found, explains) = (true, true);
            }
            let (_, besides, pings) = looks_like(&case.logged.kind);
            follows |= besides.contains(&finding.kind.as_str()) && comes_of(case, finding, pings);
        }
        match (explains, follows) {
            (true, _) => {}
            (false, true) => score.consequences += 1,
            (false, false) => score.invented.push(finding.clone()),
        }
    }
    for finding in unplaced {
        let mut open = cases
            .iter_mut()
            .filter(|case| !case.found && !case.by_count && !case.is_aside);
        let case =
            open.find(|case| shows(&case.logged.kind, &finding.kind) && agree(case, finding, 0));
        match case {
            Some(case) => case.by_count = true,
            None if could_be_untold(report, log, finding) => score.consequences += 1,
            None => score.invented.push(finding.clone()),
        }
    }
    let held = held_pings(log);
    for case in cases.iter().filter(|case| !case.is_aside) {
        let logged = case.logged;
        let tally = score.kinds.entry(logged.kind.clone()).or_default();
        tally.injected += 1;
        if case.found {
            tally.found += 1;
        } else if case.by_count {
            tally.found_by_count += 1;
        } else if is_masked(logged, &held) {
            tally.masked += 1;
        } else {
            tally.missed += 1;
            score.missed.push(name_of(logged));
        }
    }
    score
}

/// Pings in a row of one half-open connection are one silence.
fn join_silences(cases: &mut Vec<Case>) {
    let mut kept: Vec<Case> = Vec::with_capacity(cases.len());
    // Of each fault, where its newest silence is kept.
    let mut newest: HashMap<u32, usize> = HashMap::new();
    for case in cases.drain(..) {
        if case.logged.kind == "half-open" && !case.is_aside {
            let before = newest.get(&case.logged.fault).map(|at| &mut kept[*at]);
            if let Some(before) = before.filter(|last| last.to_ping + 1 == case.to_ping) {
                before.to_ping = case.to_ping;
                continue;
            }
            newest.insert(case.logged.fault, kept.len());
        }
        kept.push(case);
    }
    *cases = kept;
}

/// Of the line and the sonar that the report is of: other faults are not of one family.
fn is_of_line(report: &Report, logged: &Logged) -> bool {
    let head = &report.head;
    let same = |of_report: &Option<String>, of_log: &Option<String>| {
        of_report.is_none() || of_log.is_none() || of_report == of_log
    };
    (head.line.is_none() || logged.line.is_some())
        && same(&head.line, &logged.line)
        && same(&head.sonar, &logged.sonar)
}

fn covers(report: &Report, logged: &Logged) -> bool {
    let head = &report.head;
    let in_types = match (&head.covers, logged.record_type, logged.stream) {
        (Some(types), Some(record_type), None) => types.contains(&record_type),
        _ => true,
    };
    let in_pings = head.first_ping.is_none_or(|p| logged.ping_number >= p)
        && head.last_ping.is_none_or(|p| logged.ping_number <= p);
    let in_time = logged.packet_utc_ns.is_none_or(|utc| {
        head.from_utc_ns.is_none_or(|from| utc >= from) && head.to_utc_ns.is_none_or(|to| utc <= to)
    });
    is_of_line(report, logged) && in_types && in_pings && in_time
}

fn is_placed(finding: &Finding) -> bool {
    finding.ping_number.is_some()
        || finding.to_ping.is_some()
        || finding.frame_number.is_some()
        || finding.from_utc_ns.is_some()
}

/// Cases by ping, so that a long report is not laid beside all of a long log.
struct Index(BTreeMap<u32, Vec<usize>>);

/// Farther from its ping nothing follows from a fault.
const MAX_FOLLOWS: u32 = 3;

impl Index {
    fn of(cases: &[Case]) -> Self {
        let mut by_ping: BTreeMap<u32, Vec<usize>> = BTreeMap::new();
        for (at, case) in cases.iter().enumerate() {
            for ping in [case.logged.ping_number, case.to_ping] {
                let of_ping = by_ping.entry(ping).or_default();
                if of_ping.last() != Some(&at) {
                    of_ping.push(at);
                }
            }
        }
        Self(by_ping)
    }

    fn near(&self, finding: &Finding, cases: &[Case]) -> Vec<usize> {
        let Some((from, to)) = pings_of(finding) else {
            return (0..cases.len()).collect();
        };
        let from = from.saturating_sub(MAX_FOLLOWS);
        let to = to.saturating_add(MAX_FOLLOWS);
        let range = self.0.range(from..=to.max(from));
        range.flat_map(|(_, at)| at.iter().copied()).collect()
    }
}

fn pings_of(finding: &Finding) -> Option<(u32, u32)> {
    let from = finding.ping_number.or(finding.to_ping)?;
    Some((from, finding.to_ping.unwrap_or(from)))
}

/// Whether nothing that both say contradicts, the finding lying up to `later` pings behind.
fn agree(case: &Case, finding: &Finding, later: u32) -> bool {
    let logged = case.logged;
    fn same<T: PartialEq>(a: &Option<T>, b: &Option<T>) -> bool {
        match (a, b) {
            (Some(a), Some(b)) => a == b,
            _ => true,
        }
    }
    let in_pings = pings_of(finding).is_none_or(|(from, to)| {
        logged.ping_number <= to && case.to_ping.saturating_add(later) >= from
    });
    let in_time = match (finding.from_utc_ns, finding.to_utc_ns, logged.packet_utc_ns) {
        (Some(from), Some(to), Some(at)) => (from..=to).contains(&at),
        (Some(from), None, Some(at)) => at == from,
        (None, _, _) => true,
        // A time against a ping: not to be told.
        _ => false,
    };
    in_pings
        && in_time
        && same(&finding.sonar, &logged.sonar)
        && same(&finding.record_type, &logged.record_type)
        && same(&finding.frame_number, &logged.frame_number)
        && same(&finding.stream, &logged.stream)
        && same(&finding.context, &logged.context)
        && same(&finding.array, &logged.array)
        && same(&finding.element, &logged.element)
        && same(&finding.source, &logged.source)
        && same(&finding.quantity, &logged.quantity)
}

/// The same of what follows: it may be any record of the line.
fn comes_of(case: &Case, finding: &Finding, pings: u32) -> bool {
    let anywhere = Finding {
        record_type: None,
        frame_number: None,
        ..finding.clone()
    };
    agree(case, &anywhere, pings)
}

/// A finding without a place may come of a fault that the family cannot tell either.
fn could_be_untold(report: &Report, log: &[Logged], finding: &Finding) -> bool {
    let Some(tells) = &report.head.tells else {
        return false;
    };
    let mut untold = log
        .iter()
        .filter(|logged| covers(report, logged) && !tells.contains(&logged.kind));
    untold.any(|logged| {
        let (shows, besides, _) = looks_like(&logged.kind);
        let kind = finding.kind.as_str();
        // An answer that was held back comes beside the one that was made in its place.
        shows.contains(&kind)
            || besides.contains(&kind)
            || matches!(logged.kind.as_str(), "reorder" | "delay" | "jitter" if kind == "duplicate")
    })
}

/// Where a record of one type was held back, lost or spoiled, by fault line and place.
type Held = HashMap<(Option<String>, Option<String>, Option<u32>), BTreeSet<u32>>;

fn held_pings(log: &[Logged]) -> Held {
    let mut held = Held::new();
    for logged in log {
        let holds = matches!(
            logged.kind.as_str(),
            "reorder" | "delay" | "jitter" | "drop" | "link-down" | "corrupt" | "truncate"
        );
        if holds {
            held.entry((
                logged.sonar.clone(),
                logged.line.clone(),
                logged.record_type,
            ))
            .or_default()
            .insert(logged.ping_number);
        }
    }
    held
}

/// A record that was held back is not late where the next of its kind was held back or lost too.
fn is_masked(logged: &Logged, held: &Held) -> bool {
    let key = (
        logged.sonar.clone(),
        logged.line.clone(),
        logged.record_type,
    );
    matches!(logged.kind.as_str(), "reorder" | "delay" | "jitter")
        && held
            .get(&key)
            .is_some_and(|pings| pings.contains(&(logged.ping_number + 1)))
}

fn name_of(logged: &Logged) -> String {
    let mut name = format!(
        "{} of ping {} (fault {})",
        logged.kind, logged.ping_number, logged.fault
    );
    if let Some(record_type) = logged.record_type {
        name += &format!(", record {record_type}");
    }
    if let Some(stream) = logged.stream {
        name += &format!(", stream {stream}");
    }
    name
}

#[cfg(test)]
mod tests {
    use super::*;

    fn log(lines: &[&str]) -> Vec<Logged> {
        log_of(&lines.join("\n")).expect("a log")
    }

    fn report(lines: &[&str]) -> Report {
        Report::parse(&lines.join("\n")).expect("a report")
    }

    #[test]
    fn found_missed_and_invented_are_told_apart() {
        let log = log(&[
            r#"{"fault":1,"kind":"drop","line":"7k","ping_number":5,"record_type":7038,"strength":1}"#,
            r#"{"fault":1,"kind":"drop","line":"7k","ping_number":8,"record_type":7038}"#,
            r#"{"fault":1,"kind":"drop","line":"7k","ping_number":8,"record_type":7000}"#,
            r#"{"fault":2,"kind":"duplicate","line":"7k","ping_number":9,"record_type":7038}"#,
            r#"{"fault":2,"kind":"duplicate","line":"jsf","ping_number":9,"record_type":80}"#,
            r#"{"fault":2,"kind":"duplicate","line":"7k","ping_number":30,"record_type":7038}"#,
        ]);
        let score = score(
            &log,
            &report(&[
                r#"{"report":"me","line":"7k","covers":[7038],"last_ping":20}"#,
                r#"{"kind":"lost","ping_number":5,"record_type":7038}"#,
                r#"{"kind":"duplicate","ping_number":9}"#,
                r#"{"kind":"late","ping_number":9}"#,
                r#"{"kind":"lost","ping_number":6}"#,
            ]),
        );
        let drop = score.kinds["drop"];
        assert_eq!((drop.injected, drop.found, drop.missed), (2, 1, 1));
        assert_eq!(drop.not_covered, 1, "7000");
        let twice = score.kinds["duplicate"];
        assert_eq!((twice.injected, twice.found, twice.not_covered), (1, 1, 2));
        assert_eq!(score.missed, ["drop of ping 8 (fault 1), record 7038"]);
        let kinds: Vec<_> = score.invented.iter().map(|f| f.kind.as_str()).collect();
        assert_eq!(kinds, ["late", "lost"]);
        assert!(!score.is_clean());
    }

    #[test]
    fn what_follows_from_a_fault_is_neither_found_nor_invented() {
        let log = log(&[
            r#"{"fault":1,"kind":"truncate","line":"jsf","ping_number":5,"record_type":80}"#,
        ]);
        let score = score(
            &log,
            &report(&[
                r#"{"kind":"different","ping_number":5,"record_type":80}"#,
                r#"{"kind":"lost","ping_number":6,"record_type":80}"#,
                r#"{"kind":"lost","ping_number":7,"record_type":80}"#,
            ]),
        );
        assert_eq!(score.kinds["truncate"].found, 1);
        assert_eq!((score.consequences, score.invented.len()), (1, 1));
    }

    #[test]
    fn what_is_not_looked_at_has_consequences_too() {
        let log = log(&[
            r#"{"fault":1,"kind":"truncate","line":"jsf","ping_number":5,"record_type":2020}"#,
        ]);
        let score = score(
            &log,
            &report(&[
                r#"{"report":"me","line":"jsf","covers":[80]}"#,
                r#"{"kind":"lost","ping_number":6,"record_type":80}"#,
            ]),
        );
        assert_eq!(score.kinds["truncate"].not_covered, 1);
        assert!(score.is_clean() && score.consequences == 1);
    }

    #[test]
    fn spans_places_and_counts() {
        let log = log(&[
            r#"{"fault":1,"kind":"half-open","line":"7k","ping_number":5}"#,
            r#"{"fault":1,"kind":"half-open","line":"7k","ping_number":6}"#,
            r#"{"fault":1,"kind":"half-open","line":"7k","ping_number":9}"#,
            r#"{"fault":2,"kind":"drop","line":"vita49","ping_number":11,"record_type":4,"stream":7,"context":false,"packet_utc_ns":500}"#,
            r#"{"fault":2,"kind":"drop","line":"vita49","ping_number":11,"record_type":4,"stream":8,"context":false,"packet_utc_ns":500}"#,
            r#"{"fault":3,"kind":"duplicate","line":"imagenex872","ping_number":12,"record_type":0}"#,
            r#"{"fault":4,"kind":"dead","sonar":"bow","ping_number":20,"array":0,"element":3}"#,
            r#"{"fault":4,"kind":"dead","sonar":"bow","ping_number":21,"array":0,"element":3}"#,
        ]);
        let score = score(
            &log,
            &report(&[
                r#"{"kind":"silent","ping_number":4,"to_ping":5}"#,
                r#"{"kind":"silent","ping_number":8,"to_ping":9}"#,
                r#"{"kind":"lost","stream":7,"from_utc_ns":400,"to_utc_ns":600}"#,
                r#"{"kind":"duplicate"}"#,
                r#"{"kind":"duplicate"}"#,
                r#"{"kind":"dead","ping_number":19,"to_ping":25,"element":3}"#,
            ]),
        );
        let of = |kind: &str| {
            let tally = score.kinds[kind];
            (tally.injected, tally.found, tally.found_by_count)
        };
        assert_eq!(of("half-open"), (2, 2, 0));
        assert_eq!(of("drop"), (2, 1, 0));
        assert_eq!(of("duplicate"), (1, 0, 1));
        assert_eq!(of("dead"), (2, 2, 0));
        assert_eq!(score.invented.len(), 1, "the second duplicate");
    }

    #[test]
    fn what_comes_in_order_all_the_same_is_masked() {
        let log = log(&[
            r#"{"fault":1,"kind":"reorder","line":"7k","ping_number":5,"record_type":7038}"#,
            r#"{"fault":1,"kind":"reorder","line":"7k","ping_number":6,"record_type":7038}"#,
        ]);
        let score = score(
            &log,
            &report(&[r#"{"kind":"late","ping_number":6,"record_type":7038}"#]),
        );
        let tally = score.kinds["reorder"];
        assert_eq!((tally.found, tally.masked, tally.missed), (1, 1, 0));
    }

    #[test]
    fn a_family_that_cannot_tell_is_not_blamed() {
        let log = log(&[
            r#"{"fault":1,"kind":"corrupt-mended","line":"7k","ping_number":5,"record_type":7038}"#,
        ]);
        let score = score(&log, &report(&[r#"{"report":"me","tells":["drop"]}"#]));
        assert_eq!(score.kinds["corrupt-mended"].untold, 1);
        assert!(score.is_clean());
    }
}
