//! A server's counters as text.

use crate::io::sonar::ServerReport;

/// A line for the server, and one for every client.
pub fn server_lines(name: &str, report: &ServerReport) -> Vec<String> {
    let totals = report.totals();
    let mut lines = vec![format!(
        "{name}: {} clients now, {} ever, {} refused, {:.1} MB sent, {} commands, {} refused commands, {} framing errors",
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
