//! Outputs of samples: packets for boards, and recordings.

use super::*;

table! {
    /// ANSI/VITA 49.2 over UDP: element samples for acquisition and DSP boards. Sent with or without a receiver.
    Vita49;

    /// Destination addresses, separated by commas; multicast groups are allowed.
    send_to: Text, Default("\"127.0.0.1:4991\"");

    /// Receive arrays whose elements are sent, in this order. Default: all.
    arrays: Names, Shown("[\"rx\"]");

    /// "baseband": I and Q at the receiver's rate. "passband": real samples at passband_rate_khz, as from a converter.
    samples: Choice("baseband", "passband"), Default("\"baseband\"");

    /// Above twice the highest frequency of the band. Only with samples = "passband".
    passband_rate_khz: Khz(from(1.0, 100_000.0)), Shown("1000.0"), needed with samples = "passband";

    /// One stream per element, or one stream whose samples are vectors of all elements.
    streams: Choice("elements", "vector"), Default("\"elements\"");

    /// Stream identifier of the first stream; the others follow.
    first_stream: Integer(0, 0xFFFF_0000), Default("1");

    /// 1472 fits an Ethernet frame.
    max_packet_bytes: Integer(64, 65_504), Default("1472");

    /// Maximum rate of a ping's packets. Boards lose packets above their own limit.
    pace_mbit_per_s: Number(from(0.1, 100_000.0)), Default("400.0");

    /// Address of the interface that sends to multicast groups.
    multicast_interface: Text, Default("\"127.0.0.1\"");

    /// 1 stays in the local network.
    multicast_ttl: Integer(0, 255), Default("1");
}

table! {
    /// Element samples with a short header (docs/formats/elements.md), over TCP to every client and over UDP to fixed addresses.
    Elements;

    /// TCP. Only this computer by default: there is no password.
    listen: Text, Default("\"127.0.0.1:7172\"");

    /// UDP destination addresses, separated by commas. Left out: TCP only.
    send_to: Text, Optional("\"127.0.0.1:7173\"");

    /// Receive arrays whose elements are sent, in this order. Default: all.
    arrays: Names, Shown("[\"rx\"]");

    /// I and Q as counts with the receiver's full scale as 32767, or as volts.
    sample: Choice("i16", "f32"), Default("\"i16\"");

    /// UDP only; 1472 fits an Ethernet frame.
    max_packet_bytes: Integer(128, 65_504), Default("1472");

    /// Maximum rate of the datagrams.
    pace_mbit_per_s: Number(from(0.1, 100_000.0)), Default("400.0");

    /// Queue of each client; frames beyond it are dropped.
    client_queue_mib: Mib(1, 65_536), Default("64");
    max_clients: Integer(1, 1000), Default("8");
}

table! {
    /// SigMF: element samples with an annotation for every ping, in the folder of [record].
    Sigmf;

    /// Receive arrays whose elements are sent, in this order. Default: all.
    arrays: Names, Shown("[\"rx\"]");
}

table! {
    /// MCAP with ROS 2 messages in CDR, in the folder of [record].
    Mcap;

    /// Messages besides the pose and the frames. Without elements, the synthesis may compute beams only.
    messages: Choices("elements", "beams", "image", "lines", "soundings"), Default("[\"elements\", \"beams\", \"image\", \"lines\", \"soundings\"]");
}

table! {
    /// Multichannel WAV (RF64 above 4 GiB) of the element signals in the folder of [record], for playback on a test bench. Silence between the
    /// pings.
    Wav;

    /// Receive arrays whose elements are sent, in this order. Default: all.
    arrays: Names, Shown("[\"rx\"]");

    /// Sample rate of the bench's converters, above twice the highest frequency of the band. Default: the lowest usual rate that is 2.5 times
    /// that frequency.
    rate_khz: Khz(from(1.0, 100_000.0)), Shown("1000.0");
    sample: Choice("i16", "f32"), Default("\"i16\"");
}
