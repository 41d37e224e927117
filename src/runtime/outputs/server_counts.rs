//! Counters of a server, as text and as numbers.

use std::sync::Arc;

use super::{Report, StreamCounts};
use crate::io::sonar::{ServerReport, SonarServer};

/// Counters of an output that only serves clients: family, name and server of each of its ports.
pub(super) struct ServersReport(pub(super) Vec<(&'static str, String, Arc<SonarServer>)>);

impl Report for ServersReport {
    fn lines(&self) -> Vec<String> {
        let servers = self.0.iter();
        servers
            .flat_map(|(family, name, server)| server_lines(family, name, &server.report()))
            .collect()
    }

    fn streams(&self) -> Vec<StreamCounts> {
        let servers = self.0.iter();
        servers
            .flat_map(|(family, _, server)| server_streams(family, &server.report()))
            .collect()
    }
}

/// One line with the totals of a server, including departed clients, and one line per client.
pub(crate) fn server_lines(family: &str, name: &str, report: &ServerReport) -> Vec<String> {
    let totals = report.totals();
    let mut lines = vec![format!(
        "{family} {name}: {} clients now, {} ever, {} refused, {:.1} MB sent, {} commands, {} refused commands, {} framing errors",
        report.clients.len(),
        report.admitted,
        report.refused,
        totals.bytes_sent as f64 / 1e6,
        totals.commands,
        totals.nacks,
        totals.framing_errors,
    )];
    lines.extend(report.clients.iter().map(|client| {
        format!(
            "  {} {}: {:.1} MB, {} records sent, {} dropped, {:.1} MB waiting",
            client.transport,
            client.peer,
            client.counts.bytes_sent as f64 / 1e6,
            client.counts.records_sent,
            client.counts.records_dropped,
            client.queued_bytes as f64 / 1e6,
        )
    }));
    lines
}

/// Counters of each client of a server.
pub(crate) fn server_streams(family: &'static str, report: &ServerReport) -> Vec<StreamCounts> {
    let clients = report.clients.iter();
    let counts = clients.map(|client| StreamCounts {
        family,
        peer: format!("{} {}", client.transport, client.peer),
        receives: String::new(),
        bytes_sent: client.counts.bytes_sent,
        records_sent: client.counts.records_sent,
        records_dropped: client.counts.records_dropped,
        queued_bytes: client.queued_bytes as u64,
    });
    counts.collect()
}
