//! The keys of `[sonar.trigger]` and `[sonar.trigger_out]`.

use super::*;

table! {
    /// What makes the sonar ping. A trigger's arrival (over UDP: at the kernel) is the ping's time zero. With run.clock = "lockstep" a trigger
    /// from outside is a step; echotank replay pings on the beat instead.
    Trigger;

    /// "internal": sonar.ping's rate; "udp": every datagram (one that begins with $PETKT, as trigger_out sends it, once for each number); "tcp":
    /// every line of any client; "serial-cts", "serial-dcd": an edge of that line; "protocol": pings that a topside asks for by number; "sonar":
    /// every pulse of another one. With all but the first the rate does not bind; a topside may choose the own beat instead.
    source: Choice("internal", "udp", "tcp", "serial-cts", "serial-dcd", "protocol", "sonar"), Default("\"internal\"");

    /// Only with source = "udp" or "tcp".
    listen: Text, Optional("\"127.0.0.1:10125\"");

    /// Only with source = "serial-cts" or "serial-dcd".
    port: Text, Optional("\"/dev/ttyUSB0\"");

    /// Only with source = "serial-cts" or "serial-dcd".
    edge: Choice("rising", "falling"), Default("\"rising\"");

    /// The sonar whose pulses trigger this one. Only with source = "sonar".
    follow: Name, Optional("\"main\"");

    /// After the other one's pulse: 0 pings together, half its period in turn. Only with source = "sonar".
    delay_ms: Ms(from(0.0, 60_000.0)), Default("0.0");

    /// A trigger while the ping before is listened to: refused and counted, or the first such waits until the window is over and the rest are
    /// refused. Only with a source other than "internal".
    early: Choice("refuse", "queue"), Default("\"refuse\"");

    /// Triggers nearer to the last pulse than this are early too. Only with a source other than "internal".
    min_interval_ms: Ms(from(0.0, 60_000.0)), Default("0.0");

    /// Without a trigger for so long one is counted as absent. Only with a source other than "internal".
    watchdog_ms: Ms(above(0.0, 3.6e6)), Optional("2000.0");
}

table! {
    /// Tells others of every pulse, at its instant.
    TriggerOut;

    /// Address and port for a datagram: $PETKT,NUMBER,SECONDS,SONAR*SUM with the pulse's UTC in seconds since 1970, nine decimals, and the
    /// checksum of NMEA 0183.
    to: Text, Optional("\"127.0.0.1:10126\"");

    /// A serial port whose line is raised.
    port: Text, Optional("\"/dev/ttyUSB0\"");

    /// Only with port.
    line: Choice("rts", "dtr"), Default("\"rts\"");

    /// How long it is raised. Only with port.
    pulse_ms: Ms(from(0.1, 1000.0)), Default("1.0");
}
