//! Walk for whole line arrays: the middle of every echo at a few points along the line. Engines interpolate between these nodes.
//!
//! Delays, motion and amplitudes are smooth along a line. Delays are solved at all nodes in the same way as in [`super::arrivals`].
//! Stretch and gain are computed at three or five of them, the first and the last included.

use crate::arrivals::CHUNK;
use echotank_core::arrays::ArrayGeometry;
use echotank_core::model::{DopplerModel, PathModel};
use echotank_core::ping::{EchoCounts, PingPlan};

use super::{
    Complex64, ElementTrack, Rays, ReceiveLeg, ReceivedBatch, TransmitLeg, expand_mid_pulse,
    pattern_floor, receive_gains, refine, solve,
};

/// Maximum number of nodes along a line.
pub const MAX_NODES: usize = 9;
/// Maximum number of nodes with stretch and gain.
pub const MAX_GAIN_NODES: usize = 5;

/// Tracks of the nodes through one ping, shared by all threads.
#[derive(Debug, Default)]
pub struct NodeTracks {
    tracks: Vec<ElementTrack>,
    /// Interpolation weights of the gain nodes at every node.
    shares: [[f64; MAX_GAIN_NODES]; MAX_NODES],
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
    /// three, or five where five or nine points are given.
    pub fn compute(
        &mut self,
        plan: &PingPlan,
        array: &ArrayGeometry,
        transmit_leg: &TransmitLeg,
        along_m: &[f64],
        gain_nodes: usize,
    ) {
        let nodes = along_m.len();
        assert!(
            nodes % 2 == 1 && (3..=MAX_NODES).contains(&nodes),
            "{nodes} nodes"
        );
        assert!(
            matches!(gain_nodes, 3 | 5) && (nodes - 1).is_multiple_of(gain_nodes - 1),
            "gains at {gain_nodes} of {nodes} nodes"
        );
        self.nodes = nodes;
        self.gain_nodes = gain_nodes;
        if self.tracks.len() < nodes {
            self.tracks.resize_with(nodes, ElementTrack::default);
        }
        for (track, &along_m) in self.tracks.iter_mut().zip(along_m) {
            track.compute_at(plan, &transmit_leg.transmit, array, along_m);
        }
        let at = |k| along_m[gain_node(k, gain_nodes, nodes)];
        for (shares, &x) in self.shares.iter_mut().zip(along_m) {
            for (k, share) in shares[..gain_nodes].iter_mut().enumerate() {
                let others = (0..gain_nodes).filter(|&other| other != k);
                *share = others
                    .map(|other| (x - at(other)) / (at(k) - at(other)))
                    .product();
            }
        }
    }

    /// Number of batches of [`CHUNK`] scatterers.
    pub fn batches(transmit_leg: &TransmitLeg) -> usize {
        transmit_leg.batch_range_m.len()
    }

    /// Smallest range from the transmitter to a scatterer, metres; infinite without scatterers.
    pub fn nearest_m(transmit_leg: &TransmitLeg) -> f64 {
        let nearest_m = transmit_leg.batch_range_m.iter().map(|range_m| range_m.0);
        let receive_m = transmit_leg.nearest_receive_m.unwrap_or(f64::INFINITY);
        nearest_m.fold(receive_m, f64::min)
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
        let elements = array.elements as u64;
        let mut counts = EchoCounts::default();
        let (span, batch) = transmit_leg.batch(b);
        let n = span.len();
        out.len = n;
        let middle = self.nodes / 2;
        // Time from the leading edge to the arrival of mid-pulse, at the gain nodes.
        let mut after_s = [[0.0; CHUNK]; MAX_GAIN_NODES];
        for (node, track) in self.tracks[..self.nodes].iter().enumerate() {
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
            for (i, after_s) in after_s[k][..n].iter_mut().enumerate() {
                // (1 + doppler) s + curvature s^2 = T/2, without cancellation.
                let rate = 1.0 + received.doppler[i];
                let curvature = received.curvature_per_s[i];
                let root = (rate * rate + 4.0 * curvature * half_s).max(0.0).sqrt();
                let s = 2.0 * half_s / (rate + root);
                *after_s = rays.delay_s[i] - out.middle_s[node][i] + s;
                out.doppler[k][i] = received.doppler[i] + 2.0 * curvature * s;
            }
            out.gain[k][..n].copy_from_slice(&received.gain[..n]);
            if node == middle {
                out.curvature_per_s = received.curvature_per_s;
                counts.no_root += odd.no_root * elements;
                counts.two_roots += odd.two_roots * elements;
                for (i, amplitude) in transmit_leg.amplitude[span.clone()].iter().enumerate() {
                    out.amplitude[i] = *amplitude;
                    let keep = received.level[i] >= floor && *amplitude != Complex64::ZERO;
                    out.keep[i] = keep;
                    counts.culled += u64::from(!keep) * elements;
                    let near = received.range_m[i] < receive.one_way.wavelength_m;
                    counts.too_close += u64::from(keep & near) * elements;
                    let beyond = rays.delay_s[i] >= track.end_s();
                    counts.beyond_track += u64::from(keep & beyond) * elements;
                }
            }
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
