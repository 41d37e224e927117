//! A 7k server: TCP and UDP on one port.

use std::sync::Arc;

use echotank_protocols::sevenk::packet::MIN_MAX_PACKET_BYTES;

use super::{OpenError, RigTime, ServerSpec, ServerTimes, SonarServer, WhenFull};
use crate::io::listening::is_own;
use echotank_config::spec::SevenKSpec;
use echotank_core::settings::SettingsPort;
use echotank_emit::sevenk::protocol::SevenKProtocol;
use echotank_emit::sevenk::records::DeviceSheet;

/// Starts a 7k server on TCP and UDP at `spec.listen`; port 0 picks a port that is free for both.
///
/// # Errors
/// The packet size is out of range, an address cannot be bound, or the thread cannot start.
pub fn start_sevenk(
    spec: &SevenKSpec,
    sheet: Arc<DeviceSheet>,
    settings: Arc<dyn SettingsPort>,
    rig_time: RigTime,
) -> Result<SonarServer, OpenError> {
    start_sevenk_with(spec, sheet, settings, rig_time, ServerTimes::default())
}

/// Like [`start_sevenk`], with the given timeouts.
///
/// # Errors
/// See [`start_sevenk`].
pub fn start_sevenk_with(
    spec: &SevenKSpec,
    sheet: Arc<DeviceSheet>,
    settings: Arc<dyn SettingsPort>,
    rig_time: RigTime,
    times: ServerTimes,
) -> Result<SonarServer, OpenError> {
    let refused = || OpenError::MaxPacket {
        max_packet: spec.max_packet,
        min: MIN_MAX_PACKET_BYTES as usize,
        max: u32::MAX as usize,
    };
    let max_packet_bytes = u32::try_from(spec.max_packet).map_err(|_| refused())?;
    let protocol = SevenKProtocol::new(sheet, settings, max_packet_bytes)
        .map_err(|_| refused())?
        .refusing(is_own);
    let server = ServerSpec {
        listen: spec.listen,
        tcp: true,
        udp: true,
        client_queue_bytes: spec.client_queue_bytes,
        when_full: if spec.disconnect_when_full {
            WhenFull::Disconnect
        } else {
            WhenFull::Skip
        },
        max_clients: spec.max_clients,
    };
    SonarServer::start(&server, Arc::new(protocol), rig_time, times)
}
