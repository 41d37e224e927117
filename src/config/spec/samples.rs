//! Outputs of samples.

use std::net::{Ipv4Addr, SocketAddr};

/// ANSI/VITA 49.2 output.
#[derive(Clone, Debug, PartialEq)]
pub struct Vita49Spec {
    /// Destination addresses.
    pub send_to: Vec<SocketAddr>,
    /// Indices of the receive arrays, in the order of the samples.
    pub arrays: Vec<usize>,
    /// Rate of real passband samples, hertz. `None`: I and Q at the rate of the receiver.
    pub passband_rate_hz: Option<f64>,
    /// True for one stream of vectors with the samples of all elements.
    pub is_vector: bool,
    /// Identifier of the first stream.
    pub first_stream: u32,
    /// Maximum packet length, bytes.
    pub max_packet: usize,
    /// Maximum data rate, bytes per second.
    pub pace_bytes_per_s: f64,
    /// Address of the interface for multicast groups.
    pub multicast_interface: Ipv4Addr,
    /// Maximum number of hops of multicast packets.
    pub multicast_ttl: u32,
}

/// Element stream output.
#[derive(Clone, Debug, PartialEq)]
pub struct ElementStreamSpec {
    /// TCP address.
    pub listen: SocketAddr,
    /// UDP destination addresses.
    pub send_to: Vec<SocketAddr>,
    /// Indices of the receive arrays, in the order of the samples.
    pub arrays: Vec<usize>,
    /// True for 32-bit floats, false for 16-bit integers.
    pub is_float: bool,
    /// Maximum datagram length, bytes.
    pub max_packet: usize,
    /// Maximum data rate over UDP, bytes per second.
    pub pace_bytes_per_s: f64,
    /// Size of the queue of one TCP client, bytes.
    pub client_queue_bytes: usize,
    /// Maximum number of simultaneous TCP connections.
    pub max_clients: usize,
}

/// SigMF recording.
#[derive(Clone, Debug, PartialEq)]
pub struct SigmfSpec {
    /// Indices of the receive arrays, in the order of the samples.
    pub arrays: Vec<usize>,
}

/// MCAP recording: which messages it holds besides the pose and the frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct McapSpec {
    /// Element samples.
    pub elements: bool,
    /// Complex beams of the fan.
    pub beams: bool,
    /// Magnitudes of the beams.
    pub image: bool,
    /// Side-scan lines.
    pub lines: bool,
    /// Bottom detections.
    pub soundings: bool,
}

impl McapSpec {
    /// All messages.
    pub const ALL: Self = Self {
        elements: true,
        beams: true,
        image: true,
        lines: true,
        soundings: true,
    };
}

/// Multichannel WAV recording.
#[derive(Clone, Debug, PartialEq)]
pub struct WavSpec {
    /// Indices of the receive arrays, in the order of the channels.
    pub arrays: Vec<usize>,
    /// Sample rate, a whole number of hertz.
    pub rate_hz: u32,
    /// True for 32-bit floats, false for 16-bit integers.
    pub is_float: bool,
}

impl WavSpec {
    /// Usual sample rates of laboratory converters, Hz.
    const USUAL_RATES_HZ: [u32; 12] = [
        48_000, 96_000, 192_000, 384_000, 500_000, 768_000, 1_000_000, 2_000_000, 2_500_000,
        5_000_000, 10_000_000, 20_000_000,
    ];

    /// Lowest usual rate that is at least 2.5 times the highest frequency.
    pub fn usual_rate_hz(highest_hz: f64) -> u32 {
        let wanted_hz = 2.5 * highest_hz;
        Self::USUAL_RATES_HZ
            .into_iter()
            .find(|&rate| f64::from(rate) >= wanted_hz)
            .unwrap_or((wanted_hz / 1e6).ceil() as u32 * 1_000_000)
    }
}
