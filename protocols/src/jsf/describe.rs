//! Description of any message in one line of text. It never fails: errors in a message are part of the
//! text.

use super::{
    Control, Dvl2080, FileTime426, Message, Nmea2002, PitchRoll2020, Pressure2060, Situation2091,
    SonarData80, SystemInformation182, message_type,
};
use crate::layout::text_of;

/// Description of the message at the front of `bytes`, valid or not.
pub fn describe(bytes: &[u8]) -> String {
    let message = match Message::parse(bytes) {
        Ok(message) => message,
        Err(error) => return format!("{} B, not a JSF message: {error}", bytes.len()),
    };
    let (header, body) = (&message.header, message.body);
    let words = match header.message_type {
        message_type::SONAR_DATA => SonarData80::parse(body).map(|data| {
            format!(
                "sonar data: ping {}, {} samples of {} ns, {:?}, weighting {}, {:?} Hz",
                data.header.ping_number,
                data.header.samples(),
                data.header.sample_interval_ns,
                data.format,
                data.header.weighting,
                data.header.frequencies_hz()
            )
        }),
        message_type::NMEA => {
            Nmea2002::parse(body).map(|nmea| format!("NMEA: {}", text_of(nmea.sentence)))
        }
        message_type::PITCH_ROLL => PitchRoll2020::parse(body).map(|record| format!("{record:?}")),
        message_type::PRESSURE => Pressure2060::parse(body).map(|record| format!("{record:?}")),
        message_type::DVL => Dvl2080::parse(body).map(|record| format!("{record:?}")),
        message_type::SITUATION => Situation2091::parse(body).map(|record| format!("{record:?}")),
        message_type::SYSTEM_INFORMATION => {
            SystemInformation182::parse(body).map(|record| format!("{record:?}"))
        }
        message_type::FILE_TIMESTAMP => {
            FileTime426::parse(body).map(|record| format!("{record:?}"))
        }
        _ => Control::parse(&message).map(|control| control.to_string()),
    };
    let words = words.unwrap_or_else(|error| format!("invalid body: {error}"));
    format!(
        "JSF {} subsystem {} channel {} {} B: {words}",
        header.message_type, header.subsystem, header.channel, header.body_bytes
    )
}
