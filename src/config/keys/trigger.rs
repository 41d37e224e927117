//! The keys of `[sonar.trigger]` and `[sonar.trigger_out]`.

use super::Presence::{Default, Optional};
use super::{Kind, Table, above, from, key};

pub(super) static TRIGGER: Table = Table {
    doc: "What makes the sonar ping. A trigger's arrival (over UDP: at the kernel) is the ping's time zero. With run.clock = \"lockstep\" a trigger from outside is a step; echotank replay pings on the beat instead.",
    keys: &[
        key(
            "source",
            Kind::Choice(
                &[
                    "internal",
                    "udp",
                    "tcp",
                    "serial-cts",
                    "serial-dcd",
                    "protocol",
                    "sonar",
                ],
                &[],
            ),
            Default("\"internal\""),
            "\"internal\": sonar.ping's rate; \"udp\": every datagram (one that begins with $PETKT, as trigger_out sends it, once for each number); \"tcp\": every line of any client; \"serial-cts\", \"serial-dcd\": an edge of that line; \"protocol\": pings that a topside asks for by number; \"sonar\": every pulse of another one. With all but the first the rate does not bind; a topside may choose the own beat instead.",
        ),
        key(
            "listen",
            Kind::Text,
            Optional("\"127.0.0.1:10125\""),
            "Only with source = \"udp\" or \"tcp\".",
        ),
        key(
            "port",
            Kind::Text,
            Optional("\"/dev/ttyUSB0\""),
            "Only with source = \"serial-cts\" or \"serial-dcd\".",
        ),
        key(
            "edge",
            Kind::Choice(&["rising", "falling"], &[]),
            Default("\"rising\""),
            "Only with source = \"serial-cts\" or \"serial-dcd\".",
        ),
        key(
            "follow",
            Kind::Name,
            Optional("\"main\""),
            "The sonar whose pulses trigger this one. Only with source = \"sonar\".",
        ),
        key(
            "delay_ms",
            Kind::Number(from(0.0, 60_000.0)),
            Default("0.0"),
            "After the other one's pulse: 0 pings together, half its period in turn. Only with source = \"sonar\".",
        ),
        key(
            "early",
            Kind::Choice(&["refuse", "queue"], &[]),
            Default("\"refuse\""),
            "A trigger while the ping before is listened to: refused and counted, or the first such waits until the window is over and the rest are refused. Only with a source other than \"internal\".",
        ),
        key(
            "min_interval_ms",
            Kind::Number(from(0.0, 60_000.0)),
            Default("0.0"),
            "Triggers nearer to the last pulse than this are early too. Only with a source other than \"internal\".",
        ),
        key(
            "watchdog_ms",
            Kind::Number(above(0.0, 3.6e6)),
            Optional("2000.0"),
            "Without a trigger for so long one is counted as absent. Only with a source other than \"internal\".",
        ),
    ],
    later: &[],
};

pub(super) static TRIGGER_OUT: Table = Table {
    doc: "Tells others of every pulse, at its instant.",
    keys: &[
        key(
            "to",
            Kind::Text,
            Optional("\"127.0.0.1:10126\""),
            "Address and port for a datagram: $PETKT,NUMBER,SECONDS,SONAR*SUM with the pulse's UTC in seconds since 1970, nine decimals, and the checksum of NMEA 0183.",
        ),
        key(
            "port",
            Kind::Text,
            Optional("\"/dev/ttyUSB0\""),
            "A serial port whose line is raised.",
        ),
        key(
            "line",
            Kind::Choice(&["rts", "dtr"], &[]),
            Default("\"rts\""),
            "Only with port.",
        ),
        key(
            "pulse_ms",
            Kind::Number(from(0.1, 1000.0)),
            Default("1.0"),
            "How long it is raised. Only with port.",
        ),
    ],
    later: &[],
};
