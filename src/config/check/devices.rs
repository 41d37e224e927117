//! Outputs that imitate one maker's device.

use super::super::raw::{Problems, RawTable};
use super::super::spec::*;
use super::{Listener, address, needed_with, only_with};
use echotank_core::flow::Side;

/// Ports that WBMS takes in a row.
const WBMS_PORTS: u16 = 4;

pub(super) fn ping<'t>(
    table: &'t RawTable,
    beams: Option<&BeamsSpec>,
    listeners: &mut Vec<Listener<'t>>,
    problems: &mut Problems,
) -> Option<PingProtocolSpec> {
    let is_omniscan = table.text("device").map(|text| text == "omniscan450");
    let condition = "device = \"omniscan450\"";
    only_with(table, &["side"], is_omniscan, condition, problems);
    needed_with(table, "side", is_omniscan, condition, problems);
    let device = match is_omniscan? {
        true => PingDevice::Omniscan450 {
            side: match table.text("side")? {
                "port" => Side::Port,
                _ => Side::Starboard,
            },
        },
        false => PingDevice::Surveyor240,
    };
    if let Some(beams) = beams {
        let (entry, rule) = match device {
            PingDevice::Omniscan450 { side } => {
                let has = beams.lines.iter().any(|line| line.side == side);
                (
                    table.entry("side"),
                    (!has).then_some("needs that side's line: sonar.beams"),
                )
            }
            PingDevice::Surveyor240 => {
                let has = beams
                    .fan
                    .as_ref()
                    .is_some_and(|fan| fan.form.bottom_detection);
                let rule = "needs sonar.beams.fan with bottom_detection = true";
                (table.entry("device"), (!has).then_some(rule))
            }
        };
        if let Some(rule) = rule {
            problems.refuse(entry, rule);
        }
    }
    let listen = address(table, "listen", problems);
    for protocol in ["TCP", "UDP"] {
        listeners.extend(listen.map(|address| Listener {
            entry: table.entry("listen"),
            protocol,
            address,
            multicast: false,
        }));
    }
    let channel = u8::try_from(table.integer("channel_number")?).ok()?;
    let channels = u8::try_from(table.integer("channels")?).ok()?;
    if channel >= channels {
        problems.refuse(
            table.entry("channel_number"),
            format!("must be below channels = {channels}"),
        );
    }
    let serial = match table.given("serial_port") {
        true => Some((
            table.text("serial_port")?.to_owned(),
            u32::try_from(table.integer("serial_baud")?).ok()?,
        )),
        false => None,
    };
    Some(PingProtocolSpec {
        device,
        listen: listen?,
        serial,
        channel: (channel, channels),
        client_queue_bytes: table.count("client_queue_mib")? << 20,
        max_clients: table.count("max_clients")?,
    })
}

pub(super) fn wbms<'t>(
    table: &'t RawTable,
    listeners: &mut Vec<Listener<'t>>,
    problems: &mut Problems,
) -> Option<WbmsSpec> {
    let listen = address(table, "listen", problems)?;
    if listen.port() > u16::MAX - WBMS_PORTS {
        problems.refuse(
            table.entry("listen"),
            "leaves no room for three ports behind it",
        );
        return None;
    }
    let spec = WbmsSpec {
        listen,
        client_queue_bytes: table.count("client_queue_mib")? << 20,
        max_clients: table.count("max_clients")?,
    };
    listeners.extend((0..WBMS_PORTS).map(|number| Listener {
        entry: table.entry("listen"),
        protocol: "TCP",
        address: spec.address(number),
        multicast: false,
    }));
    Some(spec)
}
