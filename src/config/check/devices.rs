//! Checks outputs that emulate the device of one manufacturer.

use super::super::spec::*;
use super::{Listener, address};
use crate::keys;
use crate::raw::Problems;

/// Number of consecutive ports of WBMS.
const WBMS_PORTS: u16 = 4;

pub(super) fn ping<'t>(
    table: &'t keys::devices::Ping,
    beams: Option<&BeamsSpec>,
    listeners: &mut Vec<Listener<'t>>,
    problems: &mut Problems,
) -> Option<PingProtocolSpec> {
    let is_omniscan = table.device.is("omniscan450");
    let device = match is_omniscan? {
        true => PingDevice::Omniscan450 {
            side: table.side.named()?,
        },
        false => PingDevice::Surveyor240,
    };
    if let Some(beams) = beams {
        let (has, entry, rule) = match device {
            PingDevice::Omniscan450 { side } => (
                beams.lines.iter().any(|line| line.side == side),
                &table.side,
                "needs the side-scan line of that side in sonar.beams",
            ),
            PingDevice::Surveyor240 => (
                (beams.fan.as_ref()).is_some_and(|fan| fan.form.bottom_detection),
                &table.device,
                "needs sonar.beams.fan with bottom_detection = true",
            ),
        };
        if !has {
            problems.refuse(entry, rule);
        }
    }
    let listen = address(&table.listen, problems);
    for protocol in ["TCP", "UDP"] {
        listeners.extend(listen.map(|address| Listener {
            entry: &table.listen,
            protocol,
            address,
            multicast: false,
        }));
    }
    let channel = table.channel_number.to()?;
    let channels = table.channels.to()?;
    if channel >= channels {
        let rule = format!("must be below channels = {channels}");
        problems.refuse(&table.channel_number, rule);
    }
    let baud = table.serial_baud.to();
    let serial = (table.serial_port).given_and_then(|port| Some((port.clone(), baud?)))?;
    Some(PingProtocolSpec {
        device,
        listen: listen?,
        serial,
        channel: (channel, channels),
        client_queue_bytes: table.client_queue_mib.to()?,
        max_clients: table.max_clients.to()?,
    })
}

pub(super) fn wbms<'t>(
    table: &'t keys::devices::Wbms,
    listeners: &mut Vec<Listener<'t>>,
    problems: &mut Problems,
) -> Option<WbmsSpec> {
    let listen = address(&table.listen, problems)?;
    if listen.port() > u16::MAX - WBMS_PORTS {
        problems.refuse(
            &table.listen,
            "must leave three ports above it: at most 65531",
        );
        return None;
    }
    let spec = WbmsSpec {
        listen,
        client_queue_bytes: table.client_queue_mib.to()?,
        max_clients: table.max_clients.to()?,
    };
    listeners.extend((0..WBMS_PORTS).map(|number| Listener {
        entry: &table.listen,
        protocol: "TCP",
        address: spec.address(number),
        multicast: false,
    }));
    Some(spec)
}
