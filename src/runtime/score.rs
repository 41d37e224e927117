//! Compares the report of a device with the log of injected faults: faults found, faults missed, and findings without a fault.
//!
//! A finding matches a fault on two conditions. Its kind is an observable effect of the fault ([`effects`]) or the name of the fault, and its
//! position, if stated, agrees with the fault. A consequence of a fault, such as the record lost behind a truncated record, is not a false finding. A
//! finding without a position counts for the first fault that it can match, and is counted separately.

use crate::io::json_problem;
use std::collections::{BTreeMap, BTreeSet, HashMap};

use serde::{Deserialize, Serialize};

use crate::io::sonar::verification::report::{Finding, Report};

/// One injection from the fault log `faults-*.jsonl`, with the fields used for scoring.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(default)]
pub struct LoggedFault {
    /// Number of the fault in the run.
    pub fault: u32,
    /// Kind of the fault, for example `drop`.
    pub kind: String,
    /// Configured name of the affected sonar.
    pub sonar: Option<String>,
    /// Protocol family of the affected link, for example `7k`.
    pub line: Option<String>,
    /// Number of the affected ping, or of the navigation sample.
    pub ping_number: u32,
    /// UTC of the injection, rig time.
    pub utc_ns: i64,
    /// Affected navigation source.
    pub source: Option<String>,
    /// Affected navigation quantity.
    pub quantity: Option<String>,
    /// Type of the affected record, or number of the packet within its ping.
    pub record_type: Option<u32>,
    /// Index of the affected receive array.
    pub array: Option<usize>,
    /// Index of the affected element within its array.
    pub element: Option<usize>,
    /// Frame number of the affected frame of the element stream.
    pub frame_number: Option<u32>,
    /// VITA 49 stream identifier of the affected packet.
    pub stream: Option<u32>,
    /// Whether the affected VITA 49 packet is a context packet.
    pub context: Option<bool>,
    /// Timestamp of the affected VITA 49 packet, UTC.
    pub packet_utc_ns: Option<i64>,
}

/// Parses a fault log.
///
/// # Errors
/// Number of the first invalid line, from 1, and the reason.
pub fn log_of(text: &str) -> Result<Vec<LoggedFault>, (usize, String)> {
    let lines = text.lines().enumerate();
    let lines = lines.filter(|(_, line)| !line.trim().is_empty());
    lines
        .map(|(at, line)| serde_json::from_str(line).map_err(|why| (at + 1, json_problem(&why))))
        .collect()
}

/// Kind of the log's lines about pings that the daemon skipped: no device can tell them from lost ones.
pub(crate) const SKIPPED: &str = "skipped";

/// Effects of a kind of fault that a client observes.
struct Effects {
    /// Kinds of findings that show the fault.
    shown_as: &'static [&'static str],
    /// Kinds of findings that can follow from the fault.
    consequences: &'static [&'static str],
    /// Number of pings after the fault within which the consequences follow.
    within_pings: u32,
    /// Number of pings before the fault whose records can be in transit and are affected too.
    in_transit_pings: u32,
}

fn effects(kind: &str) -> Effects {
    let (shown_as, consequences, within_pings): (&[&str], &[&str], u32) = match kind {
        "drop" | "link-down" => (&["lost"], &["silent"], 0),
        "duplicate" => (&["duplicate"], &[], 0),
        "reorder" | "delay" | "jitter" => (&["late", "lost"], &[], 0),
        "corrupt" => (&["damaged", "different", "lost"], &[], 0),
        "corrupt-mended" => (&["different"], &[], 0),
        // The client parses the start of the next record as the end of the truncated record.
        "truncate" => (
            &["damaged", "different", "lost"],
            &["damaged", "different", "lost"],
            1,
        ),
        // Records in transit and records until the reconnection are lost.
        "reset" => (&["reset"], &["lost", "silent"], 3),
        "half-open" => (&["silent"], &["lost"], 1),
        SKIPPED => (&[], &["lost"], 0),
        _ => (&[], &[], 0),
    };
    Effects {
        shown_as,
        consequences,
        within_pings,
        in_transit_pings: u32::from(matches!(kind, "reset" | "half-open")),
    }
}

fn shows(kind: &str, finding: &str) -> bool {
    kind == finding || effects(kind).shown_as.contains(&finding)
}

/// Counts of the injections of one kind.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Tally {
    /// Logged injections that the report covers. Consecutive pings of one half-open connection count once.
    pub injected: u64,
    /// Injections matched by a finding with a position.
    pub found: u64,
    /// Injections matched by a finding without a position.
    pub found_by_count: u64,
    /// Unobservable injections: the next record was delayed or lost too, so the order did not change.
    pub masked: u64,
    /// Injections without a matching finding.
    pub missed: u64,
    /// Injections of a kind that the reporting device declares as undetectable.
    pub undetectable: u64,
    /// Injections in records, pings or links that the report does not cover.
    pub not_covered: u64,
}

/// Comparison of a report with a fault log.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Score {
    /// Counts by kind of fault.
    pub kinds: BTreeMap<String, Tally>,
    /// Descriptions of the missed injections.
    pub missed: Vec<String>,
    /// Findings that no fault explains.
    pub false_alarms: Vec<Finding>,
    /// Findings that follow from a fault but do not show it.
    pub consequences: u64,
}

impl Score {
    /// Whether all covered faults were found and no finding is unexplained.
    pub fn is_clean(&self) -> bool {
        self.missed.is_empty() && self.false_alarms.is_empty()
    }
}

/// An injection to be found, or the consecutive pings of one half-open connection.
struct Case<'a> {
    logged: &'a LoggedFault,
    to_ping: u32,
    found: bool,
    by_count: bool,
    /// Whether the case is outside the coverage or abilities of the report. Its consequences may still be in the report.
    is_aside: bool,
}

/// Compares a report with the fault log of the same run.
pub fn score(log: &[LoggedFault], report: &Report) -> Score {
    let mut score = Score::default();
    let mut cases = cases(log, report, &mut score);
    join_silences(&mut cases);
    match_placed(report, &mut cases, &mut score);
    match_unplaced(report, log, &mut cases, &mut score);
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

/// Injections that the report should contain. Counts the injections that the report does not cover or cannot detect.
fn cases<'a>(log: &'a [LoggedFault], report: &Report, score: &mut Score) -> Vec<Case<'a>> {
    let mut cases = Vec::new();
    let mut seen_connections = BTreeSet::new();
    for logged in log {
        let tally = score.kinds.entry(logged.kind.clone()).or_default();
        let detects = report.head.detects.as_ref();
        let is_covered = covers(report, logged) && logged.kind != SKIPPED;
        let is_undetectable =
            is_covered && detects.is_some_and(|detects| !detects.contains(&logged.kind));
        tally.not_covered += u64::from(!is_covered);
        tally.undetectable += u64::from(is_undetectable);
        let is_aside = !is_covered || is_undetectable;
        if is_aside && !is_of_link(report, logged) {
            continue;
        }
        if !is_aside && matches!(logged.kind.as_str(), "reset" | "half-open") {
            // The log has one line per port of a family.
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
    cases
}

/// Matches the findings with a position to cases.
fn match_placed(report: &Report, cases: &mut [Case], score: &mut Score) {
    let index = Index::of(cases);
    for finding in report.findings.iter().filter(|f| is_placed(f)) {
        let (mut explains, mut follows) = (false, false);
        for at in index.near(finding, cases) {
            let case = &mut cases[at];
            if !case.is_aside && shows(&case.logged.kind, &finding.kind) && agree(case, finding, 0)
            {
                (case.found, explains) = (true, true);
            }
            let effects = effects(&case.logged.kind);
            follows |= effects.consequences.contains(&finding.kind.as_str())
                && follows_from(case, finding, effects.within_pings);
        }
        match (explains, follows) {
            (true, _) => {}
            (false, true) => score.consequences += 1,
            (false, false) => score.false_alarms.push(finding.clone()),
        }
    }
}

/// Matches the findings without a position to the cases still open.
fn match_unplaced(report: &Report, log: &[LoggedFault], cases: &mut [Case], score: &mut Score) {
    for finding in report.findings.iter().filter(|f| !is_placed(f)) {
        let mut open = cases
            .iter_mut()
            .filter(|case| !case.found && !case.by_count && !case.is_aside);
        let case =
            open.find(|case| shows(&case.logged.kind, &finding.kind) && agree(case, finding, 0));
        match case {
            Some(case) => case.by_count = true,
            None if may_show_undetectable(report, log, finding) => score.consequences += 1,
            None => score.false_alarms.push(finding.clone()),
        }
    }
}

/// Joins the consecutive pings of one half-open connection into one case.
fn join_silences(cases: &mut Vec<Case>) {
    let mut kept: Vec<Case> = Vec::with_capacity(cases.len());
    // Index in `kept` of the newest silence of each fault.
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

/// Whether the fault affects the report's link and sonar. Faults without a link belong to no protocol family; skipped pings miss in all.
fn is_of_link(report: &Report, logged: &LoggedFault) -> bool {
    let head = &report.head;
    let same = |of_report: &Option<String>, of_log: &Option<String>| {
        of_report.is_none() || of_log.is_none() || of_report == of_log
    };
    (head.line.is_none() || logged.line.is_some() || logged.kind == SKIPPED)
        && same(&head.line, &logged.line)
        && same(&head.sonar, &logged.sonar)
}

fn covers(report: &Report, logged: &LoggedFault) -> bool {
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
    is_of_link(report, logged) && in_types && in_pings && in_time
}

fn is_placed(finding: &Finding) -> bool {
    finding.ping_number.is_some()
        || finding.to_ping.is_some()
        || finding.frame_number.is_some()
        || finding.from_utc_ns.is_some()
}

/// Cases by ping, so that a finding is compared only with nearby cases.
struct Index(BTreeMap<u32, Vec<usize>>);

/// Maximum distance of a consequence from its fault, pings.
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

/// Whether the position of the finding agrees with the position of the case. The finding may lie up to `later` pings after the case, or concern
/// records in transit.
fn agree(case: &Case, finding: &Finding, later: u32) -> bool {
    let logged = case.logged;
    fn same<T: PartialEq>(a: &Option<T>, b: &Option<T>) -> bool {
        match (a, b) {
            (Some(a), Some(b)) => a == b,
            _ => true,
        }
    }
    let in_pings = pings_of(finding).is_none_or(|(from, to)| {
        let before = effects(&logged.kind).in_transit_pings;
        logged.ping_number.saturating_sub(before) <= to
            && case.to_ping.saturating_add(later) >= from
    });
    let in_time = match (finding.from_utc_ns, finding.to_utc_ns, logged.packet_utc_ns) {
        (Some(from), Some(to), Some(at)) => (from..=to).contains(&at),
        (Some(from), None, Some(at)) => at == from,
        (None, _, _) => true,
        // A time and a ping number cannot be compared.
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

/// Whether the finding can be a consequence of the case in any record of the link.
fn follows_from(case: &Case, finding: &Finding, pings: u32) -> bool {
    let anywhere = Finding {
        record_type: None,
        frame_number: None,
        ..finding.clone()
    };
    agree(case, &anywhere, pings)
}

/// Whether a finding without a position can stem from a fault that the device cannot identify.
fn may_show_undetectable(report: &Report, log: &[LoggedFault], finding: &Finding) -> bool {
    let Some(detects) = &report.head.detects else {
        return false;
    };
    let mut undetectable = log
        .iter()
        .filter(|logged| covers(report, logged) && !detects.contains(&logged.kind));
    undetectable.any(|logged| {
        let effects = effects(&logged.kind);
        let kind = finding.kind.as_str();
        // A delayed answer arrives together with the next one.
        effects.shown_as.contains(&kind)
            || effects.consequences.contains(&kind)
            || matches!(logged.kind.as_str(), "reorder" | "delay" | "jitter" if kind == "duplicate")
    })
}

/// Pings with a delayed, lost or corrupted record, by sonar, link and record type.
type HeldPings = HashMap<(Option<String>, Option<String>, Option<u32>), BTreeSet<u32>>;

fn held_pings(log: &[LoggedFault]) -> HeldPings {
    let mut held = HeldPings::new();
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

/// Whether a delayed record still arrives in order because the next record of its type was delayed or lost too.
fn is_masked(logged: &LoggedFault, held: &HeldPings) -> bool {
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

fn name_of(logged: &LoggedFault) -> String {
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

    fn log(lines: &[&str]) -> Vec<LoggedFault> {
        log_of(&lines.join("\n")).expect("a log")
    }

    fn report(lines: &[&str]) -> Report {
        Report::parse(&lines.join("\n")).expect("a report")
    }

    #[test]
    fn found_missed_and_false_are_distinguished() {
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
        let kinds: Vec<_> = score.false_alarms.iter().map(|f| f.kind.as_str()).collect();
        assert_eq!(kinds, ["late", "lost"]);
        assert!(!score.is_clean());
    }

    #[test]
    fn a_consequence_of_a_fault_is_neither_found_nor_false() {
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
        assert_eq!((score.consequences, score.false_alarms.len()), (1, 1));
    }

    #[test]
    fn a_connection_fault_affects_the_records_in_transit_of_the_ping_before() {
        let log = log(&[r#"{"fault":1,"kind":"reset","line":"7k","ping_number":5}"#]);
        let score = score(
            &log,
            &report(&[
                r#"{"kind":"lost","ping_number":3,"record_type":7000}"#,
                r#"{"kind":"lost","ping_number":4,"record_type":7000}"#,
                r#"{"kind":"reset","ping_number":5}"#,
            ]),
        );
        assert_eq!(score.kinds["reset"].found, 1);
        assert_eq!((score.consequences, score.false_alarms.len()), (1, 1));
        assert_eq!(score.false_alarms[0].ping_number, Some(3));
        let log = log_of(r#"{"fault":1,"kind":"half-open","line":"7k","ping_number":10}"#);
        let silent = |from: u32| {
            let to = from + 1;
            format!(r#"{{"kind":"silent","ping_number":{from},"to_ping":{to}}}"#)
        };
        for (from, found) in [(8, 1), (7, 0)] {
            let score = super::score(log.as_ref().expect("a log"), &report(&[&silent(from)]));
            assert_eq!(score.kinds["half-open"].found, found, "from {from}");
        }
    }

    #[test]
    fn faults_outside_the_coverage_have_consequences_too() {
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
    fn findings_match_by_span_by_position_or_by_count() {
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
        assert_eq!(score.false_alarms.len(), 1, "the second duplicate");
    }

    #[test]
    fn a_delayed_record_that_arrives_in_order_is_masked() {
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
    fn records_of_a_skipped_ping_are_no_false_alarms() {
        let log = log(&[
            r#"{"kind":"skipped","sonar":"a","ping_number":5}"#,
            r#"{"kind":"skipped","sonar":"b","ping_number":6}"#,
            r#"{"fault":1,"kind":"drop","line":"7k","sonar":"a","ping_number":7,"record_type":7000}"#,
        ]);
        let report = report(&[
            r#"{"report":"me","line":"7k","sonar":"a","detects":["drop"],"first_ping":1,"last_ping":9}"#,
            r#"{"kind":"lost","ping_number":5,"record_type":7000}"#,
            r#"{"kind":"lost","ping_number":6,"record_type":7000}"#,
            r#"{"kind":"lost","ping_number":7,"record_type":7000}"#,
        ]);
        let score = score(&log, &report);
        assert_eq!((score.consequences, score.missed.len()), (1, 0));
        assert_eq!(score.kinds["drop"].found, 1);
        let other: Vec<_> = score.false_alarms.iter().map(|f| f.ping_number).collect();
        assert_eq!(other, [Some(6)], "another sonar's");
    }

    #[test]
    fn faults_that_a_device_cannot_detect_are_not_missed() {
        let log = log(&[
            r#"{"fault":1,"kind":"corrupt-mended","line":"7k","ping_number":5,"record_type":7038}"#,
        ]);
        let score = score(&log, &report(&[r#"{"report":"me","detects":["drop"]}"#]));
        assert_eq!(score.kinds["corrupt-mended"].undetectable, 1);
        assert!(score.is_clean());
    }
}
