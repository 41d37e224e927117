//! Delivery of pings from the pacer to the outputs: one lane and one or two threads per sonar.
//!
//! A ping that waits for its deadline does not delay other sonars. If samples stream, a second thread sends them, because the delivery thread
//! waits for the end of the previous ping.

use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread::{self, JoinHandle};

use crossbeam_channel::{Receiver, Sender, bounded};
use echotank_core::time::MonoNs;
use echotank_ping::rig::{PingSlot, Rig};

use super::DaemonError;
use crate::clock::Clock;
use crate::counters::{PingCounters, add, worst};
use crate::gate::Gate;
use crate::histograms::Histograms;
use crate::io::priority;
use crate::outputs::{OutputError, Outputs};

/// Lateness above which a delivery counts as a deadline miss, microseconds. Timers of an ordinary kernel under load can be late by almost
/// this much (p99 measured 3.2 ms) without a fault of the ping.
const DEADLINE_TOLERANCE_US: u64 = 5_000;

/// Maximum number of tiles of a sonar in delivery at a time.
const TILE_SLOTS: usize = 4;

/// A ping or tile in delivery.
pub(super) struct Delivery {
    pub(super) slot: Box<PingSlot>,
    /// `None` with a `fast` or `lockstep` clock: deliver at once.
    pub(super) due: Option<Deadlines>,
    /// Samples to stream; earlier samples were already sent.
    pub(super) samples: Range<usize>,
    /// Whether more of the ping follows. If so, the slot is returned once these samples are sent.
    pub(super) is_tile: bool,
}

/// Instants at which the parts of a ping are due.
#[derive(Clone, Copy, Debug)]
pub(super) struct Deadlines {
    /// Start of the pulse.
    pub(super) pulse: MonoNs,
    /// Latest useful instant of readiness: that of the first block if samples stream, else the deadline.
    pub(super) ready_by: MonoNs,
    /// Delivery of the records that belong to the whole ping.
    pub(super) deadline: MonoNs,
}

/// State shared with a delivery thread, besides its outputs.
#[derive(Clone)]
pub(super) struct DeliveryContext {
    /// Name of the sonar.
    pub(super) sonar: String,
    pub(super) clock: Arc<dyn Clock>,
    pub(super) counters: Arc<PingCounters>,
    pub(super) histograms: Arc<Histograms>,
    pub(super) gate: Arc<Gate>,
    /// SCHED_FIFO priority; 0 means ordinary scheduling.
    pub(super) priority: u8,
}

/// The pacer's side of the delivery of one sonar.
pub(super) struct Lane {
    pub(super) free: Receiver<Box<PingSlot>>,
    /// Slot of a ping that was skipped.
    pub(super) spare: Option<Box<PingSlot>>,
    pub(super) to_delivery: Sender<Delivery>,
    /// Free slots for tiles of streamed pings.
    pub(super) tiles: Receiver<Box<PingSlot>>,
    pub(super) spare_tile: Option<Box<PingSlot>>,
}

impl Lane {
    pub(super) fn slot(&mut self) -> Option<Box<PingSlot>> {
        self.spare.take().or_else(|| self.free.try_recv().ok())
    }

    pub(super) fn tile(&mut self) -> Option<Box<PingSlot>> {
        self.spare_tile
            .take()
            .or_else(|| self.tiles.try_recv().ok())
    }
}

/// A thread that owns outputs. The thread returns the error of a recorder, if any.
pub(super) type OutputThread = JoinHandle<Result<(), OutputError>>;

/// Allocates the slots of a sonar and starts its delivery thread, which ends when the lane is dropped.
pub(super) fn open_lane(
    rig: &Rig,
    sonar: usize,
    outputs: Outputs,
    context: DeliveryContext,
) -> Result<(Lane, Vec<OutputThread>), DaemonError> {
    let slots = rig.spec.run.queue_pings;
    let (outputs, streams) = outputs.split();
    let (mut to_delivery, deliveries) = bounded::<Delivery>(slots);
    let mut threads = Vec::new();
    let tile_slots = match rig.spec.run.stream_tiles && !streams.is_empty() {
        true => TILE_SLOTS,
        false => 0,
    };
    let (to_tiles, tiles) = bounded::<Box<PingSlot>>(tile_slots);
    for _ in 0..tile_slots {
        let _ = to_tiles.try_send(Box::new(rig.slot(sonar)));
    }
    if !streams.is_empty() {
        // This thread precedes the delivery thread, which waits for the end of the previous ping.
        let (to_streams, pings) = bounded::<Delivery>(slots + tile_slots);
        let on = std::mem::replace(&mut to_delivery, to_streams);
        let context = context.clone();
        let thread = thread::Builder::new()
            .name(format!("streams {sonar}"))
            .spawn(move || stream(streams, &pings, (&on, &to_tiles), &context))
            .map_err(DaemonError::Thread)?;
        threads.push(thread);
    }
    let (to_free, free) = bounded::<Box<PingSlot>>(slots);
    for _ in 0..slots {
        // Cannot fail: the channel has exactly this capacity.
        let _ = to_free.try_send(Box::new(rig.slot(sonar)));
    }
    let thread = thread::Builder::new()
        .name(format!("delivery {sonar}"))
        .spawn(move || deliver(outputs, &deliveries, &to_free, &context))
        .map_err(DaemonError::Thread)?;
    threads.push(thread);
    let lane = Lane {
        free,
        spare: None,
        to_delivery,
        tiles,
        spare_tile: None,
    };
    Ok((lane, threads))
}

/// Sends the samples of each ping at the instants at which they are received, then passes the ping on. Slots of tiles are returned.
fn stream(
    mut outputs: Outputs,
    pings: &Receiver<Delivery>,
    (on, back): (&Sender<Delivery>, &Sender<Box<PingSlot>>),
    context: &DeliveryContext,
) -> Result<(), OutputError> {
    if context.priority > 0 {
        // The daemon reports a refused priority at its start.
        let _ = priority::first_in_first_out(context.priority);
    }
    for ping in pings {
        let pulse = ping.due.map(|due| due.pulse);
        outputs.stream(&ping.slot, ping.samples.clone(), pulse);
        if ping.is_tile {
            // Cannot be full: the slot came from this channel.
            let _ = back.try_send(ping.slot);
            continue;
        }
        // The channel holds all slots, so this never blocks. An error means that the daemon is stopping.
        if on.send(ping).is_err() {
            break;
        }
    }
    outputs.close()
}

/// Encodes each ping while it waits, and delivers its records at the deadline.
fn deliver(
    mut outputs: Outputs,
    deliveries: &Receiver<Delivery>,
    free: &Sender<Box<PingSlot>>,
    context: &DeliveryContext,
) -> Result<(), OutputError> {
    if context.priority > 0 {
        // The daemon reports a refused priority at its start.
        let _ = priority::first_in_first_out(context.priority);
    }
    let mut first_error = None;
    for Delivery { slot, due, .. } in deliveries {
        let deadline = due.map(|due| due.deadline);
        outputs.encode(&slot);
        // Cannot be full: the slot came from this channel.
        let _ = free.try_send(slot);
        if let Some(deadline) = deadline {
            context.clock.sleep_until(deadline);
            let late_us = (context.clock.mono().0 - deadline.0).max(0) as u64 / 1000;
            context.histograms.start_error_us(late_us);
            worst(&context.counters.worst_late_us, late_us);
            context.counters.drift_us.store(late_us, Ordering::Relaxed);
            if late_us > DEADLINE_TOLERANCE_US {
                add(&context.counters.deadline_misses, 1);
            }
        }
        // A failed recorder (for example a full disk) is reported once; the other outputs continue.
        outputs.deliver(|error| {
            tracing::error!(sonar = context.sonar, %error, "recorder stopped");
            add(&context.counters.recordings_stopped, 1);
            first_error.get_or_insert(error);
        });
        if let Some(deadline) = deadline {
            context
                .histograms
                .note_delivery(context.clock.mono().0 - deadline.0);
        }
        context.gate.delivered();
    }
    outputs.close()?;
    first_error.map_or(Ok(()), Err)
}
