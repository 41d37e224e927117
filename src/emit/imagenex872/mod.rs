//! Imagenex 872 YellowFin protocol. The sonar head answers every switch command with one side of one ping. Sans I/O.
//!
//! The protocol description leaves some behaviour open:
//! - The first ping transmitted after a command answers it and all earlier commands of its side. A stopped sonar transmits one
//!   ping for the command.
//! - The protocol has no refusal. A range or gain beyond the limits leaves the sonar unchanged. The answer then covers the
//!   requested range, with zeros where the sonar did not receive. Bytes that are not a command get no answer.
//! - Data gain 0 to 100 covers the gain limits of the receiver. Balance gain and frequency are stored without effect.
//! - A point is the largest sample of its interval, on a linear scale with the receiver's full scale as 255. Larger values are
//!   clipped and counted.

use std::collections::VecDeque;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use echotank_protocols::imagenex872::{
    ECHO_BYTES, Side as WireSide, SwitchCommand, SwitchFraming, SwitchStream, emit_answer,
};

use super::session::{Outgoing, Protocol, Session, SessionCounts, Transport, Wants};
use echotank_core::ping::{PingOutput, PingPlan, Side};
use echotank_core::records::Datagram;
use echotank_core::settings::{
    ChangeOrigin, Requester, SettingChange, SettingsPort, StoredKey, StoredValue,
};
use echotank_core::time::UtcNs;

/// Name under which this protocol changes settings.
pub(crate) const VIA: &str = "imagenex872";

/// [`Datagram::record_type`] of the answer for a side: the number of the side in the command.
fn record_type(side: Side) -> u32 {
    match side {
        Side::Port => 0,
        Side::Starboard => 2,
    }
}

fn class(side: Side) -> Wants {
    Wants::class(record_type(side))
}

/// Maximum number of commands of a side that wait for their pings. A later one then takes the place of the last.
const MAX_WAITING: usize = 64;

/// A command that waits for a ping.
#[derive(Clone, Copy, Debug)]
struct Waiting {
    utc: UtcNs,
    range_m: u8,
}

/// Commands for one side that wait for their pings, oldest first; sessions write them, the emitter reads them.
#[derive(Debug)]
struct SideRequests(Mutex<VecDeque<Waiting>>);

impl Default for SideRequests {
    fn default() -> Self {
        Self(Mutex::new(VecDeque::with_capacity(MAX_WAITING)))
    }
}

impl SideRequests {
    /// Every statement under the lock leaves consistent commands.
    fn lock(&self) -> MutexGuard<'_, VecDeque<Waiting>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn add(&self, command: Waiting) {
        let mut waiting = self.lock();
        if waiting.len() == MAX_WAITING {
            waiting.pop_back();
        }
        waiting.push_back(command);
    }

    /// Takes the commands that a ping answers. Returns the last of them.
    fn take_before(&self, pulse: UtcNs) -> Option<Waiting> {
        let mut waiting = self.lock();
        let answered = waiting.partition_point(|command| command.utc < pulse);
        waiting.drain(..answered).next_back()
    }
}

/// Commands for both sides of the head.
#[derive(Debug, Default)]
pub struct Head {
    port: SideRequests,
    starboard: SideRequests,
}

impl Head {
    fn side(&self, side: Side) -> &SideRequests {
        match side {
            Side::Port => &self.port,
            Side::Starboard => &self.starboard,
        }
    }
}

/// Appends the requested answers of one ping. Returns the number of clipped points.
pub fn emit_ping(
    head: &Head,
    plan: &PingPlan,
    output: &PingOutput,
    (sample_rate_hz, full_scale_v): (f64, f64),
    wanted: Wants,
    into: &mut Vec<Arc<Datagram>>,
) -> u64 {
    let mut saturated = 0;
    for line in &output.lines {
        let answered = head.side(line.side).take_before(plan.stamp_utc);
        let Some(command) = answered.filter(|_| wanted.meets(class(line.side))) else {
            continue;
        };
        let range_m = f64::from(command.range_m);
        let samples_per_point =
            2.0 * range_m / plan.sound_speed_m_per_s * sample_rate_hz / ECHO_BYTES as f64;
        let mut echo = [0; ECHO_BYTES];
        for (k, point) in echo.iter_mut().enumerate() {
            let from = (k as f64 * samples_per_point) as usize;
            let to = (((k + 1) as f64 * samples_per_point) as usize).max(from + 1);
            let row = &line.amplitude;
            let largest = row[from.min(row.len())..to.min(row.len())]
                .iter()
                .fold(0.0_f32, |largest, &v| largest.max(v));
            let counts = (f64::from(largest) / full_scale_v * 255.0).round();
            saturated += u64::from(counts > 255.0);
            *point = counts.min(255.0) as u8;
        }
        let mut bytes = Vec::new();
        emit_answer(&mut bytes, &echo);
        into.push(Arc::new(Datagram {
            record_type: record_type(line.side),
            bytes,
        }));
    }
    saturated
}

/// Protocol of the sonar head on one port.
pub struct ImagenexProtocol {
    /// Settings that commands change.
    pub settings: Arc<dyn SettingsPort>,
    /// Requests shared with the emitter.
    pub head: Arc<Head>,
}

impl Protocol for ImagenexProtocol {
    fn name(&self) -> &'static str {
        VIA
    }
    fn connect(&self, _transport: Transport, peer: SocketAddr) -> Box<dyn Session> {
        Box::new(Client {
            stream: Some(SwitchStream::new(SwitchFraming)),
            link: Link {
                settings: Arc::clone(&self.settings),
                head: Arc::clone(&self.head),
                by: Requester {
                    via: VIA,
                    peer: Some(peer),
                },
                requested: Wants::NONE,
                counts: SessionCounts::default(),
            },
            held: 0,
        })
    }
    fn class(&self, record_type: u32) -> Wants {
        Wants::class(record_type)
    }
    fn has_more_requests(&self, record_type: u32) -> bool {
        let mut sides = [Side::Port, Side::Starboard].into_iter();
        let side = sides.find(|side| self::record_type(*side) == record_type);
        side.is_some_and(|side| !self.head.side(side).lock().is_empty())
    }
}

struct Client {
    /// `None` while the stream passes commands on.
    stream: Option<SwitchStream>,
    link: Link,
    held: usize,
}

struct Link {
    settings: Arc<dyn SettingsPort>,
    head: Arc<Head>,
    by: Requester,
    requested: Wants,
    counts: SessionCounts,
}

impl Client {
    fn work(&mut self, bytes: &[u8], is_end: bool, now: UtcNs) {
        let Some(mut stream) = self.stream.take() else {
            return;
        };
        if is_end {
            stream.finish();
        }
        let (before, mut taken) = (stream.skipped_bytes(), 0);
        stream.feed(bytes, |item| match item {
            Ok(bytes) => {
                taken += bytes.len();
                self.link.command(bytes, now);
            }
            Err(_) => self.link.counts.framing_errors += 1,
        });
        let passed = (stream.skipped_bytes() - before) as usize;
        self.held = (self.held + bytes.len()).saturating_sub(taken + passed);
        self.stream = Some(stream);
    }
}

impl Session for Client {
    fn receive(&mut self, bytes: &[u8], now: UtcNs, _out: &mut Vec<Outgoing>) {
        self.work(bytes, false, now);
    }
    fn is_waiting(&self) -> bool {
        self.held > 0
    }
    fn give_up_waiting(&mut self, now: UtcNs, _out: &mut Vec<Outgoing>) {
        self.work(&[], true, now);
    }
    fn wants(&self) -> Wants {
        Wants::NONE
    }
    fn take_requested(&mut self) -> Wants {
        std::mem::take(&mut self.link.requested)
    }
    fn counts(&self) -> SessionCounts {
        self.link.counts
    }
}

impl Link {
    fn command(&mut self, bytes: &[u8], now: UtcNs) {
        self.counts.commands += 1;
        let Ok(command) = SwitchCommand::parse(bytes) else {
            self.counts.nacks += 1;
            return;
        };
        let side = match command.side {
            WireSide::Port => Side::Port,
            WireSide::Starboard => Side::Starboard,
        };
        let origin = ChangeOrigin {
            utc: now,
            by: self.by,
        };
        let (min_db, max_db) = self.settings.limits().gain_db;
        let gain_db = min_db + (max_db - min_db) * f64::from(command.data_gain) / 100.0;
        let is = self.settings.settings();
        let range_m = f64::from(command.range_m);
        // Only differences are applied. Every ping has its command, and other protocols would be notified of each one.
        let mut changes = Vec::new();
        changes.extend((is.range_m != range_m).then_some(SettingChange::RangeM(range_m)));
        changes.extend((is.gain_db != gain_db).then_some(SettingChange::GainDb(gain_db)));
        changes.extend((!is.pinging).then_some(SettingChange::PingTimes(1)));
        for change in changes {
            let refused = self.settings.apply(change, origin).is_err();
            self.counts.nacks += u64::from(refused);
        }
        for (name, value) in [
            ("frequency index", command.frequency_index),
            ("balance gain", command.balance_gain),
        ] {
            let key = StoredKey {
                via: VIA,
                name,
                place: record_type(side),
            };
            let value = StoredValue::Integer(value.into());
            if self.settings.stored(key).as_ref() != Some(&value) {
                // Storing fails only if thousands of values are stored, and the protocol cannot report a failure.
                let _ = self.settings.store(key, value, origin);
            }
        }
        self.head.side(side).add(Waiting {
            utc: now,
            range_m: command.range_m,
        });
        self.requested = self.requested.union(class(side));
    }
}
