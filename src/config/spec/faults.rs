//! Faults and fault requests. The catalogue is [`FaultRequest::KINDS`].

use serde::{Deserialize, Serialize};

use super::NavChannel;
use super::words::NamedChoice;
use crate::did_you_mean;

/// Request for a fault, from a `[[fault]]` table or while the rig runs.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FaultRequest {
    /// Name in [`FaultRequest::KINDS`].
    pub kind: String,
    /// Name of the sonar; `None` means every sonar.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sonar: Option<String>,
    /// Index of a receive array; `None` means every array.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub array: Option<usize>,
    /// Index of an element; `None` means every element.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub element: Option<usize>,
    /// Index of the other element of a fault with two elements.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub other: Option<usize>,
    /// Name of a navigation source; `None` means every source.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub source: Option<String>,
    /// Quantity of the source; `None` means every quantity.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub quantity: Option<String>,
    /// Size of the fault, in the unit of the kind.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub value: Option<f64>,
    /// Start after the first ping, seconds of rig time; `None` means now.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub at_s: Option<f64>,
    /// Duration, seconds; `None` means unlimited.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub for_s: Option<f64>,
    /// Time in which the fault grows to its full size, seconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ramp_s: Option<f64>,
    /// Probability of injection per ping or record.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub probability: Option<f64>,
    /// Number of consecutive pings that one injection lasts.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub burst: Option<u32>,
    /// Seed of the random draws; `None` means 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub seed: Option<u64>,
}

/// Fault request that has been checked.
#[derive(Clone, Debug, PartialEq)]
pub struct FaultSpec {
    /// Type and size of the fault.
    pub kind: FaultKind,
    /// Name in [`FaultRequest::KINDS`].
    pub name: &'static str,
    /// Name of the sonar; `None` means every sonar.
    pub sonar: Option<String>,
    /// Name of a navigation source; `None` means every source.
    pub source: Option<String>,
    /// Start after the first ping, seconds of rig time; `None` means now.
    pub at_s: Option<f64>,
    /// Duration, seconds.
    pub for_s: f64,
    /// Time in which the fault grows to its full size, seconds.
    pub ramp_s: f64,
    /// Probability of injection per ping or record.
    pub probability: f64,
    /// Number of consecutive pings that one injection lasts.
    pub burst: u32,
    /// Seed of the random draws.
    pub seed: u64,
}

/// Type and size of a fault.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FaultKind {
    /// Fault of receive channels.
    Element {
        /// Type and size of the fault.
        fault: ElementFault,
        /// Index of a receive array; `None` means every array.
        array: Option<usize>,
        /// Index of an element; `None` means every element.
        element: Option<usize>,
    },
    /// Fault of the link to the clients.
    Transport(TransportFault),
    /// Fault of the TCP connections of the clients.
    Connection(ConnectionFault),
    /// Fault of the samples of navigation sources.
    Nav {
        /// Type and size of the fault.
        fault: NavFault,
        /// Quantity; `None` means every quantity.
        quantity: Option<NavChannel>,
    },
    /// Fault of the received bytes of live navigation sources.
    NavBytes(NavByteFault),
    /// A pulse is not transmitted. Its ping number is used up.
    TriggerMissed,
    /// The sonar is triggered a second time.
    TriggerDouble {
        /// Delay of the second trigger, seconds.
        s: f64,
    },
    /// The pulse that marks a whole second in outgoing navigation is not sent.
    PulseLost,
    /// The ZDA sentence of an output states a later second.
    WrongZda {
        /// Shift of the second, seconds.
        s: f64,
    },
    /// The time stamps of the records are late.
    WrongSecond {
        /// Shift of the time stamp, seconds.
        s: f64,
    },
}

/// Fault of one receive channel. Amplitudes are volts at the input of the converter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ElementFault {
    /// The samples are zero.
    Dead,
    /// I and Q are constant.
    Stuck {
        /// Value of I and Q.
        volts: f64,
    },
    /// The sign of the samples is inverted.
    Inverted,
    /// The samples of two elements are exchanged.
    Swapped {
        /// Index of the other element.
        with: usize,
    },
    /// The level changes.
    Gain {
        /// Change of the level, dB.
        db: f64,
    },
    /// The phase changes.
    Phase {
        /// Change of the phase, radians.
        rad: f64,
    },
    /// I and Q are limited.
    Clipping {
        /// Limit of I and Q.
        volts: f64,
    },
    /// I and Q are offset.
    Offset {
        /// Offset of I and Q.
        volts: f64,
    },
    /// Circular Gaussian noise is added.
    NoiseBurst {
        /// Root mean square of the noise, volts.
        volts: f64,
    },
    /// A 50 Hz tone is added to I and Q, with continuous phase from ping to ping.
    MainsHum {
        /// Root mean square of the tone in I and in Q, volts.
        volts: f64,
    },
    /// A bit of the two's complement codes of I and Q is stuck.
    AdcBitStuck {
        /// Index of the bit; 0 is the least significant bit.
        bit: u32,
        /// True if the bit is stuck at 1, false at 0.
        high: bool,
    },
    /// The signal of another element is added.
    Crosstalk {
        /// Index of the other element.
        from: usize,
        /// Level of the added signal, dB.
        db: f64,
    },
    /// The sample clock is too fast: the echo at t appears at t (1 + ppm 1e-6).
    ClockDrift {
        /// Rate error, parts per million.
        ppm: f64,
    },
    /// The samples are delayed. The first samples are 0.
    SampleSlip {
        /// Delay in samples.
        samples: usize,
    },
}

/// Fault of the link to the clients, applied per record. Recordings are not affected.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum TransportFault {
    /// The record is not sent.
    Drop,
    /// The record is sent twice.
    Duplicate,
    /// The record is exchanged with the record of the next ping.
    Reorder,
    /// One byte of the body changes.
    Corrupt {
        /// True if the checksum is recomputed for the changed byte.
        mended: bool,
    },
    /// The second half of the record is missing.
    Truncate,
    /// The record is delayed until the first delivery after this time.
    Delay {
        /// Delay, seconds of rig time.
        s: f64,
    },
    /// The record is delayed as by `Delay`, by a random time per record.
    Jitter {
        /// Maximum delay, seconds of rig time.
        s: f64,
    },
    /// All records of the ping are lost.
    LinkDown,
}

/// Fault of the connections to the clients.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ConnectionFault {
    /// Every TCP client is reset.
    Reset,
    /// The clients stay connected, but nothing is sent or received.
    HalfOpen,
}

/// Fault of a navigation source.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum NavFault {
    /// The source sends nothing.
    Off,
    /// The source repeats its last sample.
    Stuck,
    /// The values are random in the range of the quantity.
    Garbage,
    /// The values have an offset. Positions move to the north.
    Wrong {
        /// Offset in metres, metres per second or radians.
        by: f64,
    },
    /// Only one of several samples is kept.
    Slow {
        /// Number of samples per kept sample.
        one_in: u32,
    },
    /// The samples arrive late.
    Delayed {
        /// Delay, seconds.
        s: f64,
    },
    /// The source is silent and active in turn.
    Intermittent {
        /// Length of each silent and of each active interval, seconds.
        s: f64,
    },
}

/// Fault of the bytes of a received sentence.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NavByteFault {
    /// The checksum is wrong.
    Checksum,
    /// The sentence is split into two lines in its first field.
    Cut,
    /// Binary bytes precede the sentence.
    Noise {
        /// Number of bytes.
        bytes: usize,
    },
}

/// Refusal of a fault request.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{key}: {rule}")]
pub struct FaultRefused {
    /// Key of the request that violates a rule.
    pub key: &'static str,
    /// The violated rule.
    pub rule: String,
}

fn refused<T>(key: &'static str, rule: impl Into<String>) -> Result<T, FaultRefused> {
    let rule = rule.into();
    Err(FaultRefused { key, rule })
}

/// A kind of fault, for checks and forms.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct FaultCatalogueEntry {
    /// Name of the kind.
    #[serde(rename = "kind")]
    pub name: &'static str,
    /// Part of the rig that the fault affects.
    pub group: &'static str,
    /// Unit of `value`; empty if the kind has no value.
    pub unit: &'static str,
    /// Smallest value.
    pub min: f64,
    /// Largest value.
    pub max: f64,
    /// Effect, in one sentence.
    pub effect: &'static str,
}

const ELEMENTS: &str = "elements";
const LINK: &str = "link to the clients";
const NAVIGATION: &str = "navigation";
const TIME: &str = "time";

const fn kind(
    group: &'static str,
    name: &'static str,
    unit: &'static str,
    min: f64,
    max: f64,
    effect: &'static str,
) -> FaultCatalogueEntry {
    FaultCatalogueEntry {
        name,
        group,
        unit,
        min,
        max,
        effect,
    }
}

impl FaultRequest {
    /// The catalogue of faults.
    pub const KINDS: &'static [FaultCatalogueEntry] = &[
        kind(ELEMENTS, "dead", "", 0.0, 0.0, "The samples are zero."),
        kind(
            ELEMENTS,
            "stuck",
            "volts",
            -1e6,
            1e6,
            "I and Q keep this value.",
        ),
        kind(
            ELEMENTS,
            "inverted",
            "",
            0.0,
            0.0,
            "The sign of the samples is inverted.",
        ),
        kind(
            ELEMENTS,
            "swapped",
            "",
            0.0,
            0.0,
            "The samples are exchanged with those of the other element.",
        ),
        kind(
            ELEMENTS,
            "gain",
            "dB",
            -200.0,
            100.0,
            "The level changes by this many dB.",
        ),
        kind(
            ELEMENTS,
            "phase",
            "degrees",
            -360.0,
            360.0,
            "The phase changes by this angle.",
        ),
        kind(
            ELEMENTS,
            "clipping",
            "volts",
            1e-12,
            1e6,
            "I and Q are limited to this value.",
        ),
        kind(
            ELEMENTS,
            "offset",
            "volts",
            -1e6,
            1e6,
            "This voltage is added to I and Q.",
        ),
        kind(
            ELEMENTS,
            "noise-burst",
            "volts rms",
            0.0,
            1e6,
            "Noise of this level is added.",
        ),
        kind(
            ELEMENTS,
            "mains-hum",
            "volts rms",
            0.0,
            1e6,
            "A 50 Hz tone of this level is added to I and Q.",
        ),
        kind(
            ELEMENTS,
            "adc-bit-stuck-high",
            "bit",
            0.0,
            31.0,
            "This bit of the converter stays 1; bit 0 is the least significant.",
        ),
        kind(
            ELEMENTS,
            "adc-bit-stuck-low",
            "bit",
            0.0,
            31.0,
            "This bit of the converter stays 0; bit 0 is the least significant.",
        ),
        kind(
            ELEMENTS,
            "crosstalk",
            "dB",
            -200.0,
            40.0,
            "The signal of the other element is added at this level.",
        ),
        kind(
            ELEMENTS,
            "clock-drift",
            "ppm",
            -1000.0,
            1000.0,
            "The sample clock is too fast by this share.",
        ),
        kind(
            ELEMENTS,
            "sample-slip",
            "samples",
            1.0,
            1e9,
            "The samples are delayed by this number of samples.",
        ),
        kind(LINK, "drop", "", 0.0, 0.0, "Records are not sent."),
        kind(LINK, "duplicate", "", 0.0, 0.0, "Records are sent twice."),
        kind(
            LINK,
            "reorder",
            "",
            0.0,
            0.0,
            "Records are exchanged with those of the next ping.",
        ),
        kind(
            LINK,
            "corrupt",
            "",
            0.0,
            0.0,
            "One byte of the body changes.",
        ),
        kind(
            LINK,
            "corrupt-mended",
            "",
            0.0,
            0.0,
            "One byte of the body changes, and the checksum fits.",
        ),
        kind(
            LINK,
            "truncate",
            "",
            0.0,
            0.0,
            "The second half of the record is missing.",
        ),
        kind(
            LINK,
            "delay",
            "ms",
            0.001,
            600_000.0,
            "Records are sent later by this time.",
        ),
        kind(
            LINK,
            "jitter",
            "ms",
            0.001,
            600_000.0,
            "Records are sent later by a random time up to this.",
        ),
        kind(
            LINK,
            "link-down",
            "",
            0.0,
            0.0,
            "Every record of the ping is lost.",
        ),
        kind(
            LINK,
            "reset",
            "",
            0.0,
            0.0,
            "The TCP connections of the clients are reset.",
        ),
        kind(
            LINK,
            "half-open",
            "",
            0.0,
            0.0,
            "The clients stay connected, but nothing is sent or received.",
        ),
        kind(
            NAVIGATION,
            "nav-off",
            "",
            0.0,
            0.0,
            "The source gives nothing.",
        ),
        kind(
            NAVIGATION,
            "nav-stuck",
            "",
            0.0,
            0.0,
            "The source repeats its last sample.",
        ),
        kind(
            NAVIGATION,
            "nav-garbage",
            "",
            0.0,
            0.0,
            "The values are random.",
        ),
        kind(
            NAVIGATION,
            "nav-wrong",
            "m, m/s or degrees",
            -1e6,
            1e6,
            "This error is added to the quantity.",
        ),
        kind(
            NAVIGATION,
            "nav-slow",
            "samples for one",
            2.0,
            1e6,
            "One sample in this many is kept.",
        ),
        kind(
            NAVIGATION,
            "nav-delayed",
            "ms",
            1.0,
            600_000.0,
            "The samples arrive later by this time.",
        ),
        kind(
            NAVIGATION,
            "nav-intermittent",
            "ms",
            1.0,
            600_000.0,
            "The source is silent and active in turn, each for this time.",
        ),
        kind(
            NAVIGATION,
            "nav-checksum",
            "",
            0.0,
            0.0,
            "The checksum of a live sentence is wrong.",
        ),
        kind(
            NAVIGATION,
            "nav-cut",
            "",
            0.0,
            0.0,
            "A live sentence is split into two lines.",
        ),
        kind(
            NAVIGATION,
            "nav-noise",
            "bytes",
            1.0,
            1000.0,
            "This many random bytes precede a live sentence.",
        ),
        kind(
            TIME,
            "trigger-missed",
            "",
            0.0,
            0.0,
            "A pulse is missing, and its number is used up.",
        ),
        kind(
            TIME,
            "trigger-double",
            "ms",
            0.001,
            60_000.0,
            "The sonar is triggered a second time, later by this time.",
        ),
        kind(
            TIME,
            "pps-loss",
            "",
            0.0,
            0.0,
            "The pulse of the navigation output is missing.",
        ),
        kind(
            TIME,
            "wrong-zda",
            "s",
            -1e6,
            1e6,
            "ZDA of the navigation output is wrong by this time.",
        ),
        kind(
            TIME,
            "wrong-second",
            "s",
            -1e6,
            1e6,
            "The time stamps of the records are late by this time.",
        ),
    ];

    /// Checks the request. Returns the fault, or the violated rule.
    pub fn checked(&self) -> Result<FaultSpec, FaultRefused> {
        let known = Self::KINDS.iter().find(|kind| kind.name == self.kind);
        let Some(&FaultCatalogueEntry {
            name,
            unit,
            min,
            max,
            ..
        }) = known
        else {
            let names = Self::KINDS.iter().map(|kind| kind.name);
            let known: Vec<_> = names.clone().collect();
            let hint = did_you_mean(&self.kind, names);
            let hint = hint.map_or(String::new(), |hint| format!("; {hint}"));
            let rule = format!("must be one of {}{hint}", known.join(", "));
            return refused("kind", rule);
        };
        let value = match (unit, self.value) {
            ("", None) => 0.0,
            ("", Some(_)) => {
                return refused("value", format!("{name} has no value; leave the key out"));
            }
            (_, Some(value)) if (min..=max).contains(&value) => value,
            _ => return refused("value", format!("must be from {min} to {max} {unit}")),
        };
        if matches!(unit, "bit" | "samples" | "samples for one" | "bytes") && value.fract() != 0.0 {
            return refused("value", "must be a whole number");
        }
        let of_nav = name.starts_with("nav-");
        for (key, given) in [("source", &self.source), ("quantity", &self.quantity)] {
            if given.is_some() && !of_nav {
                return refused(key, format!("{name} is not a navigation fault"));
            }
        }
        if matches!(name, "nav-checksum" | "nav-cut" | "nav-noise") && self.quantity.is_some() {
            return refused(
                "quantity",
                format!("{name} affects whole sentences; leave quantity out"),
            );
        }
        if of_nav && self.sonar.is_some() {
            return refused(
                "sonar",
                "navigation faults affect every sonar; leave sonar out",
            );
        }
        if name == "nav-wrong" && self.quantity.is_none() {
            return refused("quantity", "nav-wrong needs one: the value has its unit");
        }
        let between = |key, value: Option<f64>, default, min: f64, max: f64| match value {
            None => Ok(default),
            Some(value) if (min..=max).contains(&value) => Ok(value),
            Some(value) => refused(key, format!("{value}: must be from {min} to {max}")),
        };
        let kind = self.kind_of(name, value)?;
        let at_s = match self.at_s {
            None => None,
            some => Some(between("at_s", some, 0.0, 0.0, 1e9)?),
        };
        if self.burst == Some(0) {
            return refused("burst", "must be at least 1");
        }
        Ok(FaultSpec {
            kind,
            name,
            sonar: self.sonar.clone(),
            source: self.source.clone(),
            at_s,
            for_s: between("for_s", self.for_s, f64::INFINITY, 0.0, 1e9)?,
            ramp_s: between("ramp_s", self.ramp_s, 0.0, 0.0, 1e9)?,
            probability: between("probability", self.probability, 1.0, 0.0, 1.0)?,
            burst: self.burst.unwrap_or(1).min(MAX_BURST),
            seed: self.seed.unwrap_or(0),
        })
    }

    fn kind_of(&self, name: &'static str, value: f64) -> Result<FaultKind, FaultRefused> {
        let other = match (name, self.other) {
            ("swapped" | "crosstalk", Some(other)) => other,
            ("swapped" | "crosstalk", None) => {
                return refused("other", format!("{name} needs a second element"));
            }
            (_, Some(_)) => return refused("other", "only with swapped and crosstalk"),
            (_, None) => 0,
        };
        if name == "swapped" && self.element.is_none() {
            return refused("element", "swapped needs two elements");
        }
        let bit_stuck = |high| ElementFault::AdcBitStuck {
            bit: value as u32,
            high,
        };
        let element = match name {
            "dead" => Some(ElementFault::Dead),
            "stuck" => Some(ElementFault::Stuck { volts: value }),
            "inverted" => Some(ElementFault::Inverted),
            "swapped" => Some(ElementFault::Swapped { with: other }),
            "gain" => Some(ElementFault::Gain { db: value }),
            "phase" => Some(ElementFault::Phase {
                rad: value.to_radians(),
            }),
            "clipping" => Some(ElementFault::Clipping { volts: value }),
            "offset" => Some(ElementFault::Offset { volts: value }),
            "noise-burst" => Some(ElementFault::NoiseBurst { volts: value }),
            "mains-hum" => Some(ElementFault::MainsHum { volts: value }),
            "adc-bit-stuck-high" => Some(bit_stuck(true)),
            "adc-bit-stuck-low" => Some(bit_stuck(false)),
            "crosstalk" => Some(ElementFault::Crosstalk {
                from: other,
                db: value,
            }),
            "clock-drift" => Some(ElementFault::ClockDrift { ppm: value }),
            "sample-slip" => Some(ElementFault::SampleSlip {
                samples: value as usize,
            }),
            _ => None,
        };
        if let Some(fault) = element {
            return Ok(FaultKind::Element {
                fault,
                array: self.array,
                element: self.element,
            });
        }
        if self.array.is_some() || self.element.is_some() {
            return refused("element", format!("{name} is not an element fault"));
        }
        let quantity = self.channel()?;
        let nav = |fault| FaultKind::Nav { fault, quantity };
        Ok(match name {
            "reset" => FaultKind::Connection(ConnectionFault::Reset),
            "half-open" => FaultKind::Connection(ConnectionFault::HalfOpen),
            "nav-off" => nav(NavFault::Off),
            "nav-stuck" => nav(NavFault::Stuck),
            "nav-garbage" => nav(NavFault::Garbage),
            "nav-wrong" => {
                use NavChannel::{Heading, RollPitch};
                let of_angle = matches!(quantity, Some(Heading | RollPitch));
                let by = if of_angle { value.to_radians() } else { value };
                nav(NavFault::Wrong { by })
            }
            "nav-slow" => nav(NavFault::Slow {
                one_in: value as u32,
            }),
            "nav-delayed" => nav(NavFault::Delayed { s: value * 1e-3 }),
            "nav-intermittent" => nav(NavFault::Intermittent { s: value * 1e-3 }),
            "nav-checksum" => FaultKind::NavBytes(NavByteFault::Checksum),
            "nav-cut" => FaultKind::NavBytes(NavByteFault::Cut),
            "nav-noise" => FaultKind::NavBytes(NavByteFault::Noise {
                bytes: value as usize,
            }),
            "trigger-missed" => FaultKind::TriggerMissed,
            "trigger-double" => FaultKind::TriggerDouble { s: value * 1e-3 },
            "pps-loss" => FaultKind::PulseLost,
            "wrong-zda" => FaultKind::WrongZda { s: value },
            "wrong-second" => FaultKind::WrongSecond { s: value },
            "drop" => FaultKind::Transport(TransportFault::Drop),
            "duplicate" => FaultKind::Transport(TransportFault::Duplicate),
            "reorder" => FaultKind::Transport(TransportFault::Reorder),
            "corrupt" => FaultKind::Transport(TransportFault::Corrupt { mended: false }),
            "corrupt-mended" => FaultKind::Transport(TransportFault::Corrupt { mended: true }),
            "truncate" => FaultKind::Transport(TransportFault::Truncate),
            "delay" => FaultKind::Transport(TransportFault::Delay { s: value * 1e-3 }),
            "jitter" => FaultKind::Transport(TransportFault::Jitter { s: value * 1e-3 }),
            _ => FaultKind::Transport(TransportFault::LinkDown),
        })
    }
}

impl FaultRequest {
    fn channel(&self) -> Result<Option<NavChannel>, FaultRefused> {
        let Some(wanted) = &self.quantity else {
            return Ok(None);
        };
        let channel = NavChannel::from_word(wanted);
        channel.map(Some).ok_or_else(|| {
            let names = NavChannel::WORDS.iter().map(|(_, name)| *name);
            let known: Vec<_> = names.clone().collect();
            let hint = did_you_mean(wanted, names);
            let hint = hint.map_or(String::new(), |hint| format!("; {hint}"));
            let rule = format!("must be one of {}{hint}", known.join(", "));
            FaultRefused {
                key: "quantity",
                rule,
            }
        })
    }
}

/// Maximum length of a burst. Every ping looks back over as many pings.
const MAX_BURST: u32 = 10_000;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_kind_of_the_catalogue_can_be_asked_for_and_nothing_else() {
        for &FaultCatalogueEntry {
            name,
            unit,
            min,
            max,
            ..
        } in FaultRequest::KINDS
        {
            let two = matches!(name, "swapped" | "crosstalk");
            let request = FaultRequest {
                kind: name.into(),
                value: (!unit.is_empty()).then_some(max),
                element: two.then_some(1),
                other: two.then_some(2),
                quantity: (name == "nav-wrong").then(|| "heading".into()),
                ..FaultRequest::default()
            };
            let spec = request
                .checked()
                .unwrap_or_else(|why| panic!("{name}: {why}"));
            assert_eq!(spec.name, name);
            let wrong = FaultRequest {
                value: Some(if unit.is_empty() { 1.0 } else { min - 1.0 }),
                ..request.clone()
            };
            assert_eq!(wrong.checked().expect_err(name).key, "value");
        }
        let unknown = FaultRequest {
            kind: "gremlin".into(),
            ..FaultRequest::default()
        };
        assert_eq!(unknown.checked().expect_err("unknown").key, "kind");
    }

    #[test]
    fn what_makes_no_sense_is_refused_with_its_key() {
        let ask = |json: &str| {
            let request: FaultRequest = serde_json::from_str(json).expect("JSON");
            request.checked().expect_err(json).key
        };
        for (json, key) in [
            (r#"{"kind": "drop", "element": 3}"#, "element"),
            (r#"{"kind": "dead", "other": 3}"#, "other"),
            (r#"{"kind": "swapped", "element": 3}"#, "other"),
            (r#"{"kind": "drop", "probability": 1.5}"#, "probability"),
            (r#"{"kind": "drop", "burst": 0}"#, "burst"),
            (r#"{"kind": "drop", "at_s": -1}"#, "at_s"),
            (r#"{"kind": "sample-slip", "value": 1.5}"#, "value"),
            (r#"{"kind": "gain"}"#, "value"),
            (r#"{"kind": "drop", "source": "gnss"}"#, "source"),
            (r#"{"kind": "nav-off", "sonar": "bow"}"#, "sonar"),
            (r#"{"kind": "nav-off", "element": 3}"#, "element"),
            (r#"{"kind": "nav-off", "quantity": "mood"}"#, "quantity"),
            (r#"{"kind": "nav-wrong", "value": 3}"#, "quantity"),
            (r#"{"kind": "nav-slow", "value": 2.5}"#, "value"),
            (r#"{"kind": "nav-noise", "value": 2.5}"#, "value"),
            (r#"{"kind": "nav-cut", "quantity": "heading"}"#, "quantity"),
        ] {
            assert_eq!(ask(json), key, "{json}");
        }
    }
}
