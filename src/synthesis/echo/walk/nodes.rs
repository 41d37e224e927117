//! Walk for whole arrays: the middle of every echo at a few points along the line or arc. Engines interpolate between these nodes.
//!
//! Delays, motion and amplitudes are smooth along it. Delays are solved at all nodes in the same way as in [`super::arrivals`].
//! Stretch and gain are computed at three, five or all nine of them, the first and the last included.

use crate::arrivals::CHUNK;
use echotank_core::arrays::{ArrayGeometry, ArrayLine};
use echotank_core::model::{DopplerModel, PathModel};
use echotank_core::ping::{EchoCounts, PingPlan};
use echotank_core::simd::widest;
use glam::DVec3;

use super::{
    Complex64, ElementTrack, Rays, ReceiveLeg, ReceivedBatch, TransmitLeg, expand_mid_pulse,
    pattern_floor, receive_gains, refine, solve,
};

/// Maximum number of nodes along a line.
pub const MAX_NODES: usize = 9;
/// Maximum number of nodes with stretch and gain.
pub const MAX_GAIN_NODES: usize = MAX_NODES;

/// Tracks of the nodes through one ping, shared by all threads.
#[derive(Debug, Default)]
pub struct NodeTracks {
    tracks: Vec<ElementTrack>,
    /// Interpolation weights of the gain nodes at every node.
    shares: [[f64; MAX_GAIN_NODES]; MAX_NODES],
    /// Interpolation weights of the first, the middle and the last node at every node.
    coarse_shares: [[f64; 3]; MAX_NODES],
    /// Batches that are computed at these three nodes only are as far away or farther, metres.
    coarse_from_m: f64,
    /// Distances of the batches, as [`Self::measure`] finds them, metres.
    nearest_m: Vec<f64>,
    nodes: usize,
    gain_nodes: usize,
}

/// Per-thread buffers of [`NodeTracks::batch`].
#[derive(Default)]
pub struct NodeWorkspace {
    rays: Rays,
    received: ReceivedBatch,
}

/// Echoes of up to [`CHUNK`] scatterers at all nodes.
pub struct NodeBatch {
    /// Number of scatterers.
    pub len: usize,
    /// Arrival of the middle of the pulse at each node, seconds after the start of the pulse.
    pub middle_s: [[f64; CHUNK]; MAX_NODES],
    /// Stretch minus one, at mid-pulse.
    pub doppler: [[f64; CHUNK]; MAX_GAIN_NODES],
    /// Half the second derivative of the emission time at the middle node, per second.
    pub curvature_per_s: [f64; CHUNK],
    /// Gain of the receive leg, volts per uPa at 1 m.
    pub gain: [[f64; CHUNK]; MAX_GAIN_NODES],
    /// Amplitude of the transmit leg, uPa at 1 m from the scatterer.
    pub amplitude: [Complex64; CHUNK],
    /// True if the echo is above the floor of culling.
    pub keep: [bool; CHUNK],
}

impl Default for NodeBatch {
    fn default() -> Self {
        let zero = [0.0; CHUNK];
        Self {
            len: 0,
            middle_s: [zero; MAX_NODES],
            doppler: [zero; MAX_GAIN_NODES],
            curvature_per_s: zero,
            gain: [zero; MAX_GAIN_NODES],
            amplitude: [Complex64::ZERO; CHUNK],
            keep: [false; CHUNK],
        }
    }
}

/// Index of gain node `k` of `gain_nodes` among `nodes` nodes.
pub fn gain_node(k: usize, gain_nodes: usize, nodes: usize) -> usize {
    k * (nodes - 1) / (gain_nodes - 1)
}

impl NodeTracks {
    /// Tracks with capacity for polylines of `segments` segments, so that no ping allocates.
    pub fn with_room_for(segments: usize) -> Self {
        Self {
            tracks: (0..MAX_NODES)
                .map(|_| ElementTrack::with_room_for(segments))
                .collect(),
            ..Self::default()
        }
    }

    /// Computes the tracks of the points `along_m` from the centre of `array`. Their number is odd, from three to [`MAX_NODES`]. `gain_nodes` is
    /// three, five where five or nine points are given, or nine of nine. Batches of scatterers that [`Self::measure`] found at `coarse_from_m` or beyond are
    /// computed at the first, the middle and the last node, and interpolated at the others: stretches, gains, and the squares of receive legs. On a line at
    /// rest these squares are quadratic exactly; motion leaves about v/c of the error that delays would have.
    pub fn compute(
        &mut self,
        plan: &PingPlan,
        array: &ArrayGeometry,
        transmit_leg: &TransmitLeg,
        along_m: &[f64],
        gain_nodes: usize,
        coarse_from_m: f64,
    ) {
        let nodes = along_m.len();
        assert!(
            nodes % 2 == 1 && (3..=MAX_NODES).contains(&nodes),
            "{nodes} nodes"
        );
        assert!(
            matches!(gain_nodes, 3 | 5 | MAX_GAIN_NODES)
                && (nodes - 1).is_multiple_of(gain_nodes - 1),
            "gains at {gain_nodes} of {nodes} nodes"
        );
        self.nodes = nodes;
        self.gain_nodes = gain_nodes;
        self.coarse_from_m = coarse_from_m;
        if self.tracks.len() < nodes {
            self.tracks.resize_with(nodes, ElementTrack::default);
        }
        for (track, &along_m) in self.tracks.iter_mut().zip(along_m) {
            track.compute_at(plan, transmit_leg.sent(), array, along_m);
        }
        let shares = |of: usize, k: usize, x: f64| -> f64 {
            let at = |k| along_m[gain_node(k, of, nodes)];
            let others = (0..of).filter(|&other| other != k);
            others
                .map(|other| (x - at(other)) / (at(k) - at(other)))
                .product()
        };
        for (node, &x) in along_m.iter().enumerate() {
            for (k, share) in self.shares[node][..gain_nodes].iter_mut().enumerate() {
                *share = shares(gain_nodes, k, x);
            }
            for (k, share) in self.coarse_shares[node].iter_mut().enumerate() {
                *share = shares(3, k, x);
            }
        }
    }

    /// Number of batches of [`CHUNK`] scatterers.
    pub fn batches(transmit_leg: &TransmitLeg) -> usize {
        transmit_leg.batch_range_m.len()
    }

    /// Distance of the nearest scatterer from the transmitter or from the line between the ends of `array`, at the start of the pulse, metres. Less than
    /// the distance only beyond `enough_m`. [`Self::batch`] needs the distances of its ping.
    pub fn measure(
        &mut self,
        plan: &PingPlan,
        array: &ArrayGeometry,
        transmit_leg: &TransmitLeg,
        enough_m: f64,
    ) -> f64 {
        let world_from_body = plan.segments[0].world_from_body;
        let line = ArrayLine::new(array, |body_m| {
            transmit_leg.transmit.offset_m(world_from_body * body_m)
        });
        let reach_m = line.reach_m();
        self.nearest_m.clear();
        self.nearest_m
            .extend((0..Self::batches(transmit_leg)).map(|b| {
                let sent_m = transmit_leg.batch_range_m[b].0;
                let least_m = sent_m - reach_m;
                if least_m >= enough_m && !transmit_leg.has_images() {
                    return least_m;
                }
                let (_, batch) = transmit_leg.batch(b);
                let places = batch.x_m.iter().zip(batch.y_m).zip(batch.z_m);
                let distances_m =
                    places.map(|((&x_m, &y_m), &z_m)| line.distance_m(DVec3::new(x_m, y_m, z_m)));
                distances_m.fold(sent_m, f64::min)
            }));
        self.nearest_m.iter().copied().fold(f64::INFINITY, f64::min)
    }

    /// Computes the echoes of batch `b`. Counts are in scatterer-element pairs; the caller sets `used`.
    pub fn batch(
        &self,
        plan: &PingPlan,
        array: &ArrayGeometry,
        transmit_leg: &TransmitLeg,
        b: usize,
        work: &mut NodeWorkspace,
        out: &mut NodeBatch,
    ) -> EchoCounts {
        let NodeWorkspace { rays, received } = work;
        let c = plan.sound_speed_m_per_s;
        let receive = ReceiveLeg::new(plan, array);
        let floor = pattern_floor(plan);
        let half_s = 0.5 * plan.pulse.duration_s;
        let is_arc = array.radius_m.is_some();
        let elements = array.elements as u64;
        let mut counts = EchoCounts::default();
        let (span, batch) = transmit_leg.batch(b);
        let n = span.len();
        out.len = n;
        let middle = self.nodes / 2;
        // Time from the leading edge to the arrival of mid-pulse, at the gain nodes.
        let mut after_s = [[0.0; CHUNK]; MAX_GAIN_NODES];
        // At the middle of the line, and at the node that hears the most: near by, patterns point elsewhere at its ends.
        let (mut near, mut beyond) = ([false; CHUNK], [false; CHUNK]);
        let mut loudest = [0.0f64; CHUNK];
        let is_coarse = self.nearest_m[b] >= self.coarse_from_m;
        let step = if is_coarse { middle } else { 1 };
        for (node, track) in self.tracks[..self.nodes].iter().enumerate().step_by(step) {
            let odd = solve(track, c, batch, rays);
            if plan.model.path == PathModel::Continuous {
                refine(plan, &transmit_leg.transmit, track, batch, rays);
            }
            out.middle_s[node][..n].copy_from_slice(&rays.delay_s[..n]);
            let at_gain = |k: &usize| gain_node(*k, self.gain_nodes, self.nodes) == node;
            let Some(k) = (0..self.gain_nodes).find(at_gain) else {
                continue;
            };
            receive_gains(&receive, transmit_leg, span.clone(), rays, received);
            if plan.model.doppler == DopplerModel::StretchQuadratic {
                expand_mid_pulse(plan, transmit_leg, track, batch, rays, received);
            } else {
                received.curvature_per_s[..n].fill(0.0);
            }
            let (middle_s, doppler) = (&out.middle_s[node], &mut out.doppler[k]);
            let loudest = &mut loudest;
            let after_s = &mut after_s[k];
            widest(
                #[inline(always)]
                || {
                    for i in 0..n.min(CHUNK) {
                        // (1 + doppler) s + curvature s^2 = T/2, without cancellation.
                        let rate = 1.0 + received.doppler[i];
                        let curvature = received.curvature_per_s[i];
                        let root = (rate * rate + 4.0 * curvature * half_s).max(0.0).sqrt();
                        let s = 2.0 * half_s / (rate + root);
                        after_s[i] = rays.delay_s[i] - middle_s[i] + s;
                        doppler[i] = received.doppler[i] + 2.0 * curvature * s;
                        loudest[i] = loudest[i].max(received.level[i]);
                    }
                },
            );
            out.gain[k][..n].copy_from_slice(&received.gain[..n]);
            if node == middle {
                out.curvature_per_s = received.curvature_per_s;
                counts.no_root += odd.no_root * elements;
                counts.two_roots += odd.two_roots * elements;
                for i in 0..n {
                    near[i] = received.range_m[i] < receive.one_way.wavelength_m;
                    beyond[i] = rays.delay_s[i] >= track.end_s();
                }
            }
        }
        for (i, amplitude) in transmit_leg.amplitude[span].iter().enumerate() {
            out.amplitude[i] = *amplitude;
            let audible = loudest[i] >= floor || is_arc;
            let keep = audible && *amplitude != Complex64::ZERO;
            out.keep[i] = keep;
            counts.culled += u64::from(!keep) * elements;
            counts.too_close += u64::from(keep & near[i]) * elements;
            counts.beyond_track += u64::from(keep & beyond[i]) * elements;
        }
        if is_coarse {
            let gain_of = |node: usize| node * (self.gain_nodes - 1) / (self.nodes - 1);
            let coarse = [0, middle, self.nodes - 1];
            for node in coarse {
                let after_s = &after_s[gain_of(node)][..n];
                for (middle_s, after_s) in out.middle_s[node][..n].iter_mut().zip(after_s) {
                    *middle_s += after_s;
                }
            }
            let between = |node: &usize| !coarse.contains(node);
            for node in (0..self.nodes).filter(between) {
                let shares = &self.coarse_shares[node];
                interpolate_delays(
                    &mut out.middle_s,
                    [c, half_s],
                    batch.range_m,
                    coarse,
                    node,
                    shares,
                );
                if (node * (self.gain_nodes - 1)).is_multiple_of(self.nodes - 1) {
                    let coarse = coarse.map(gain_of);
                    interpolate(&mut out.doppler, n, coarse, gain_of(node), shares);
                    interpolate(&mut out.gain, n, coarse, gain_of(node), shares);
                }
            }
            return counts;
        }
        for (middle_s, shares) in out.middle_s[..self.nodes].iter_mut().zip(&self.shares) {
            for (share, after_s) in shares.iter().zip(&after_s[..self.gain_nodes]) {
                for (middle_s, after_s) in middle_s[..n].iter_mut().zip(after_s) {
                    *middle_s += share * after_s;
                }
            }
        }
        counts
    }

    /// Number of nodes.
    pub fn count(&self) -> usize {
        self.nodes
    }
}

/// Sets the first `n` values of `node` to sums of those of the nodes `from`.
fn interpolate(
    values: &mut [[f64; CHUNK]],
    n: usize,
    from: [usize; 3],
    node: usize,
    shares: &[f64; 3],
) {
    let Ok([to, first, middle, last]) = values.get_disjoint_mut([node, from[0], from[1], from[2]])
    else {
        return;
    };
    widest(
        #[inline(always)]
        || {
            for i in 0..n.min(CHUNK) {
                to[i] = shares[0] * first[i] + shares[1] * middle[i] + shares[2] * last[i];
            }
        },
    );
}

/// Sets the delays of `node` such that the squares of its receive legs are sums of those of the nodes `from`. `first_m`: lengths of the transmit legs.
fn interpolate_delays(
    middle_s: &mut [[f64; CHUNK]],
    [c, half_s]: [f64; 2],
    first_m: &[f64],
    from: [usize; 3],
    node: usize,
    shares: &[f64; 3],
) {
    let Ok([to, first, middle, last]) =
        middle_s.get_disjoint_mut([node, from[0], from[1], from[2]])
    else {
        return;
    };
    widest(
        #[inline(always)]
        || {
            for i in 0..first_m.len().min(CHUNK) {
                let before_s = first_m[i] / c + half_s;
                let square = |at_s: f64| (at_s - before_s) * (at_s - before_s);
                let sum = shares[0] * square(first[i])
                    + shares[1] * square(middle[i])
                    + shares[2] * square(last[i]);
                to[i] = before_s + sum.max(0.0).sqrt();
            }
        },
    );
}
