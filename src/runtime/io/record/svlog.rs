//! `.svlog` files: Ping protocol frames as sent to clients, after a JSON frame (message 10) with the name of the recorder.

use std::path::Path;

use echotank_protocols::ping_protocol::{emit_frame, message_id};
use serde_json::json;

use super::RecordError;
use super::stream::StreamRecorder;
use echotank_config::spec::PingDevice;
use echotank_core::time::UtcNs;

/// Creates the file, replacing an existing one, with the frame that names the recorder. `url` is the address of the device; `utc` is the start of the
/// recording.
pub(crate) fn create(
    path: &Path,
    device: PingDevice,
    url: &str,
    utc: UtcNs,
) -> Result<StreamRecorder, RecordError> {
    let product = match device {
        PingDevice::Omniscan450 { .. } => "os450",
        PingDevice::Surveyor240 => "mbes24016",
    };
    let timestamp = chrono::DateTime::from_timestamp_nanos(utc.0).to_rfc3339();
    let words = json!({
        "session_id": 1,
        // Frames count milliseconds from `timestamp`. Readers subtract these uptimes.
        "os_uptime": 0.0,
        "process_uptime": 0.0,
        "session_uptime": 0.0,
        "session_devices": [{ "url": url, "product_id": product }],
        "session_platform": null,
        "session_clients": [],
        "session_plan_name": null,
        "is_recording": true,
        "sonarlink_version": "",
        "process_version": concat!("echotank ", env!("CARGO_PKG_VERSION")),
        "timestamp": timestamp,
        "timestamp_timezone_offset": 0,
        "simulated": true,
    });
    let mut frame = Vec::new();
    emit_frame(&mut frame, message_id::JSON_WRAPPER, 0, 0, |buf| {
        buf.extend_from_slice(format!("{words:#}").as_bytes());
    });
    StreamRecorder::create(path, &frame)
}

#[cfg(test)]
mod tests {
    use echotank_protocols::ping_protocol::{Frame, PingFraming, PingStream};

    use super::*;

    #[test]
    fn frames_follow_the_words_that_say_what_recorded_them() {
        let dir = tempfile::tempdir().expect("folder");
        let path = dir.path().join("a.svlog");
        let utc = UtcNs(1_400_000_000_000_000_000);
        let mut log =
            create(&path, PingDevice::Surveyor240, "tcp://127.0.0.1:1", utc).expect("creates");
        let mut frame = Vec::new();
        emit_frame(&mut frame, message_id::WATER_STATS, 1, 0, |buf| {
            buf.extend([0; 8]);
        });
        for _ in 0..2 {
            log.write(&frame).expect("writes");
        }
        log.close(&[]).expect("closes");
        let mut ids = Vec::new();
        let mut stream = PingStream::new(PingFraming);
        stream.feed(&std::fs::read(&path).expect("there"), |item| {
            let frame = Frame::parse(item.expect("whole")).expect("a frame");
            if frame.message_id == message_id::JSON_WRAPPER {
                let words: serde_json::Value = serde_json::from_slice(frame.payload).expect("JSON");
                assert_eq!(words["session_devices"][0]["product_id"], "mbes24016");
                assert_eq!(words["timestamp"], "2014-05-13T16:53:20+00:00");
            }
            ids.push(frame.message_id);
        });
        assert_eq!(ids, [10, 118, 118]);
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn a_full_disk_and_a_missing_folder_are_errors_that_name_the_file() {
        for (path, action) in [
            ("/no/such/folder/a.svlog", "create"),
            ("/dev/full", "write"),
        ] {
            let error = create(Path::new(path), PingDevice::Surveyor240, "", UtcNs(0))
                .expect_err("cannot be written");
            let text = error.to_string();
            assert!(text.contains(path) && text.contains(action), "{text}");
        }
    }
}
