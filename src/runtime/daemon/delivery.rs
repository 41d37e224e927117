//! The way of a ping from the pacer to its outputs: one lane and one or two threads per sonar.
//!
//! A ping that waits for its deadline holds up no other sonar's. Where samples stream, a thread of their own sends them ahead of the delivery
//! thread, which waits for the end of the ping before.

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

/// Later than this is a miss, microseconds: what an ordinary kernel's timers may be late under load (p99 measured 3.2 ms) without
/// anything being wrong with the ping.
const DEADLINE_TOLERANCE_US: u64 = 5_000;

/// Tiles of a sonar's pings that may be on their context at a time.
const TILE_SLOTS: usize = 4;

/// A ping on its context out.
pub(super) struct Delivery {
    pub(super) slot: Box<PingSlot>,
    /// None where time is the pipeline's own: at once.
    pub(super) due: Option<Due>,
    /// Its samples that stream; those before have left already.
    pub(super) samples: Range<usize>,
    /// There is more of the ping to come: when these samples have left the slot goes back.
    pub(super) is_tile: bool,
}

/// When what a ping makes is due.
#[derive(Clone, Copy, Debug)]
pub(super) struct Due {
    /// The start of its pulse.
    pub(super) pulse: MonoNs,
    /// The last instant at which it is of use: the first block's where samples stream, else the deadline.
    pub(super) ready_by: MonoNs,
    /// All that leaves at the end of the ping.
    pub(super) deadline: MonoNs,
}

/// What a delivery thread works with besides its outputs.
#[derive(Clone)]
pub(super) struct DeliveryContext {
    /// The sonar's name.
    pub(super) sonar: String,
    pub(super) clock: Arc<dyn Clock>,
    pub(super) counters: Arc<PingCounters>,
    pub(super) histograms: Arc<Histograms>,
    pub(super) gate: Arc<Gate>,
    /// SCHED_FIFO; 0: ordinary.
    pub(super) priority: u8,
}

/// The pipeline's end of one sonar's context out. Each sonar has its own, with its own thread: a ping that waits for its deadline holds up no
/// other sonar's.
pub(super) struct Lane {
    pub(super) free: Receiver<Box<PingSlot>>,
    /// A slot whose ping was skipped.
    pub(super) spare: Option<Box<PingSlot>>,
    pub(super) to_delivery: Sender<Delivery>,
    /// For tiles of pings that stream.
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

/// A thread that owns outputs, and what became of their recorders.
pub(super) type OutputThread = JoinHandle<Result<(), OutputError>>;

/// Makes the slots of a sonar and starts its delivery thread, which ends when the lane is dropped.
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
        // Ahead of the delivery thread, which waits for the end of the ping before.
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
        // Cannot fail: the channel holds exactly this many.
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

/// Lets the samples of each ping leave as they would be heard, and hands it on at once; a tile goes back.
fn stream(
    mut outputs: Outputs,
    pings: &Receiver<Delivery>,
    (on, back): (&Sender<Delivery>, &Sender<Box<PingSlot>>),
    context: &DeliveryContext,
) -> Result<(), OutputError> {
    if context.priority > 0 {
        // What is not allowed was said when the daemon started.
        let _ = priority::first_in_first_out(context.priority);
    }
    for ping in pings {
        let pulse = ping.due.map(|due| due.pulse);
        outputs.stream(&ping.slot, ping.samples.clone(), pulse);
        if ping.is_tile {
            // Its place in the channel is free: it came from there.
            let _ = back.try_send(ping.slot);
            continue;
        }
        // It holds as many as there are slots. Nobody there: the daemon ends.
        if on.send(ping).is_err() {
            break;
        }
    }
    outputs.close()
}

/// Encodes each ping while it waits, and hands its records over at the deadline.
fn deliver(
    mut outputs: Outputs,
    deliveries: &Receiver<Delivery>,
    free: &Sender<Box<PingSlot>>,
    context: &DeliveryContext,
) -> Result<(), OutputError> {
    if context.priority > 0 {
        // What is not allowed was said when the daemon started.
        let _ = priority::first_in_first_out(context.priority);
    }
    let mut first_error = None;
    for Delivery { slot, due, .. } in deliveries {
        let deadline = due.map(|due| due.deadline);
        outputs.encode(&slot);
        // Its place in the channel is free: it came from there.
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
        // A recorder that fails (a full disk) is reported once; the topsides go on.
        outputs.deliver(|error| {
            tracing::error!(sonar = context.sonar, %error, "recorder stopped");
            add(&context.counters.recordings_stopped, 1);
            first_error.get_or_insert(error);
        });
        if let Some(deadline) = deadline {
            context
                .histograms
                .handed_over_us(context.clock.mono().0 - deadline.0);
        }
        context.gate.delivered();
    }
    outputs.close()?;
    first_error.map_or(Ok(()), Err)
}
