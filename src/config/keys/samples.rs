//! Outputs of samples: packets for boards, and recordings.

use super::*;

table! {
    /// ANSI/VITA 49.2 over UDP: element samples for acquisition and DSP boards. Sent whether or not anybody listens.
    Vita49;

    /// Where to; several addresses with commas between them, groups (multicast) among them.
    send_to: Text, Default("\"127.0.0.1:4991\"");

    /// Receive arrays whose elements go out, in this order. Left out: all.
    arrays: Names, Shown("[\"rx\"]");

    /// I and Q at the receiver's rate, or what a converter of passband_rate_khz would have seen.
    samples: Choice("baseband", "passband"), Default("\"baseband\"");

    /// Above twice the highest frequency of the band. Only with samples = "passband".
    passband_rate_khz: Khz(from(1.0, 100_000.0)), Shown("1000.0");

    /// A stream for every element, or one whose samples are vectors of all.
    streams: Choice("elements", "vector"), Default("\"elements\"");

    /// Stream identifier of the first; the others count up.
    first_stream: Integer(0, 0xFFFF_0000), Default("1");

    /// 1472 fits an Ethernet frame.
    max_packet_bytes: Integer(64, 65_504), Default("1472");

    /// Packets of a ping leave no faster than this, or boards lose them.
    pace_mbit_per_s: Number(from(0.1, 100_000.0)), Default("400.0");

    /// Address of this computer from which groups are sent to.
    multicast_interface: Text, Default("\"127.0.0.1\"");

    /// 1 stays in the local network.
    multicast_ttl: Integer(0, 255), Default("1");
}

table! {
    /// Element samples with little around them (protocols/README.md), over TCP to whoever connects and over UDP to fixed addresses.
    Elements;

    /// TCP. Only this computer by default: there is no password.
    listen: Text, Default("\"127.0.0.1:7172\"");

    /// UDP; several addresses with commas between them. Left out: TCP only.
    send_to: Text, Optional("\"127.0.0.1:7173\"");

    /// Receive arrays whose elements go out, in this order. Left out: all.
    arrays: Names, Shown("[\"rx\"]");

    /// I and Q as counts, the receiver's full scale as 32767, or as volts.
    sample: Choice("i16", "f32"), Default("\"i16\"");

    /// Of UDP; 1472 fits an Ethernet frame.
    max_packet_bytes: Integer(128, 65_504), Default("1472");

    /// Datagrams leave no faster than this.
    pace_mbit_per_s: Number(from(0.1, 100_000.0)), Default("400.0");

    /// What may wait for one slow client before its frames are dropped.
    client_queue_mib: Mib(1, 65_536), Default("64");
    max_clients: Integer(1, 1000), Default("8");
}

table! {
    /// SigMF: element samples with an annotation for every ping, in the folder of [record].
    Sigmf;

    /// Receive arrays whose elements go out, in this order. Left out: all.
    arrays: Names, Shown("[\"rx\"]");
}

table! {
    /// Multichannel WAV (RF64 above 4 GiB) of what the elements hear, for benches that play it out, in the folder of [record]. Silence between
    /// the pings.
    Wav;

    /// Receive arrays whose elements go out, in this order. Left out: all.
    arrays: Names, Shown("[\"rx\"]");

    /// Rate of the bench's converters; above twice the highest frequency of the band. Left out: the lowest usual rate that is 2.5 times that
    /// frequency.
    rate_khz: Khz(from(1.0, 100_000.0)), Shown("1000.0");
    sample: Choice("i16", "f32"), Default("\"i16\"");
}
