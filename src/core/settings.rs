//! Settings of a sonar while it runs: values, limits, requests to change them, and the journal of changes.

use std::net::SocketAddr;

use crate::time::UtcNs;

// ---------------------------------------------------------------- the ping

/// Settings that an operator or a topside unit can change while the sonar runs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SonarSettings {
    /// True while the sonar pings.
    pub pinging: bool,
    /// Maximum slant range, metres.
    pub range_m: f64,
    /// Maximum ping rate, hertz; 0 only while `pinging` is false.
    pub max_ping_rate_hz: f64,
    /// Source level, dB re 1 uPa at 1 m.
    pub source_level_db: f64,
    /// Receiver gain, dB.
    pub gain_db: f64,
    /// Pulse length, seconds.
    pub pulse_duration_s: f64,
}

/// Inclusive limits of the settings. The maxima determine buffer sizes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SettingLimits {
    /// Slant range, metres.
    pub range_m: (f64, f64),
    /// Ping rate, hertz.
    pub ping_rate_hz: (f64, f64),
    /// Source level, dB re 1 uPa at 1 m.
    pub source_level_db: (f64, f64),
    /// Receiver gain, dB.
    pub gain_db: (f64, f64),
    /// Pulse length, seconds.
    pub pulse_duration_s: (f64, f64),
}

/// Origin of the ping triggers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum TriggerSource {
    /// The sonar's own ping rate.
    #[default]
    Internal,
    /// External pulses. The sonar itself starts only pings requested by number.
    External,
}

/// One requested change of the settings.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum SettingChange {
    /// Maximum slant range, metres.
    RangeM(f64),
    /// Maximum ping rate, hertz. 0 pauses pinging; a later rate above 0 resumes it.
    MaxPingRateHz(f64),
    /// Source level, dB re 1 uPa at 1 m.
    SourceLevelDb(f64),
    /// Receiver gain, dB.
    GainDb(f64),
    /// Pulse length, seconds.
    PulseDurationS(f64),
    /// Start pinging.
    Start,
    /// Stop pinging.
    Stop,
    /// Transmit this number of pings at the ping rate, then stop. This request ends a [`Self::Start`].
    PingTimes(u32),
    /// Change the trigger source.
    Trigger(TriggerSource),
}

/// Key of a device setting that the program stores for the client but the model does not use.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct StoredKey {
    /// Protocol of the setting.
    pub via: &'static str,
    /// Name of the setting in the protocol.
    pub name: &'static str,
    /// Index of the channel or subsystem; 0 if the device has only one.
    pub place: u32,
}

/// Value of a stored setting, reported back unchanged.
#[derive(Clone, Debug, PartialEq)]
pub enum StoredValue {
    /// Integer value.
    Integer(i64),
    /// List of numbers.
    Numbers(Vec<f64>),
    /// Text value.
    Text(String),
}

/// Requester of a change: a protocol, page or command, and its address.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Requester {
    /// Name of the protocol, page or command that requests the change.
    pub via: &'static str,
    /// Network address of the client, if there is one.
    pub peer: Option<SocketAddr>,
}

/// Time and requester of a change.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ChangeOrigin {
    /// Rig time.
    pub utc: UtcNs,
    /// Requester.
    pub by: Requester,
}

impl From<UtcNs> for ChangeOrigin {
    /// Origin of a change by the program itself.
    fn from(utc: UtcNs) -> Self {
        let by = Requester {
            via: "echotank",
            peer: None,
        };
        Self { utc, by }
    }
}

/// A change that took effect.
#[derive(Clone, Debug, PartialEq)]
pub enum Changed {
    /// A setting of the model.
    Setting(SettingChange),
    /// A stored setting.
    Stored(StoredKey, StoredValue),
}

/// One entry of the journal of changes.
#[derive(Clone, Debug, PartialEq)]
pub struct JournalEntry {
    /// Version of the settings after this change.
    pub version: u64,
    /// Time and origin.
    pub origin: ChangeOrigin,
    /// The change.
    pub changed: Changed,
}

/// Result of an accepted change.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SettingApplied {
    /// Settings after the change.
    pub settings: SonarSettings,
    /// Number of changes so far; 0 is the configuration.
    pub version: u64,
}

/// A refused change; the settings are unchanged.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[error("{key} = {value}: must be {rule}")]
pub struct SettingRefused {
    /// Configuration key of the setting.
    pub key: &'static str,
    /// Refused value.
    pub value: f64,
    /// Violated rule.
    pub rule: SettingRule,
}

/// Rule for the value of a setting.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum SettingRule {
    /// The value must be finite.
    #[error("a finite number")]
    Finite,
    /// The value must lie in an inclusive interval.
    #[error("from {min} to {max}")]
    Between {
        /// Minimum.
        min: f64,
        /// Maximum.
        max: f64,
    },
    /// The value must be zero or lie in an inclusive interval.
    #[error("0 or from {min} to {max}")]
    ZeroOrBetween {
        /// Minimum.
        min: f64,
        /// Maximum.
        max: f64,
    },
    /// Too many settings are stored.
    #[error("one of at most {most} stored settings")]
    TooMany {
        /// Maximum number of stored settings.
        most: usize,
    },
}

/// Access of any protocol, page or command to the settings of one sonar.
pub trait SettingsPort: Send + Sync {
    /// Settings of the next ping.
    fn settings(&self) -> SonarSettings;
    /// Current trigger source.
    fn trigger(&self) -> TriggerSource;
    /// Limits of the settings.
    fn limits(&self) -> SettingLimits;
    /// Version of the settings; increases with every change, including stored settings.
    fn version(&self) -> u64;
    /// Applies a change. Returns the violated rule if the change is refused.
    fn apply(
        &self,
        change: SettingChange,
        origin: ChangeOrigin,
    ) -> Result<SettingApplied, SettingRefused>;
    /// Stores a setting that the model does not use. Refused only if too many settings are stored.
    fn store(
        &self,
        key: StoredKey,
        value: StoredValue,
        origin: ChangeOrigin,
    ) -> Result<(), SettingRefused>;
    /// Value of a stored setting.
    fn stored(&self, key: StoredKey) -> Option<StoredValue>;
    /// Changes after `version`, oldest first. Old entries may be absent.
    fn changes_since(&self, version: u64) -> Vec<JournalEntry>;
}
