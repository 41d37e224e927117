//! Reports the state of the service to systemd (sd_notify(3)): ready, alive, status, stopping.

use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixDatagram};

/// Connection to the service manager, if there is one.
pub(crate) struct Notify {
    way: Option<(UnixDatagram, SocketAddr)>,
}

impl Notify {
    /// Uses the socket that the environment variable `NOTIFY_SOCKET` names.
    pub(crate) fn from_environment() -> Self {
        Self::to(std::env::var("NOTIFY_SOCKET").ok().as_deref())
    }

    /// Uses a socket path, or an abstract name after `@`.
    fn to(name: Option<&str>) -> Self {
        let way = name.and_then(|name| {
            let address = match name.strip_prefix('@') {
                Some(hidden) => SocketAddr::from_abstract_name(hidden),
                None => SocketAddr::from_pathname(name),
            };
            let socket = UnixDatagram::unbound().ok()?;
            // A manager that does not read must not stop the daemon.
            socket.set_nonblocking(true).ok()?;
            Some((socket, address.ok()?))
        });
        Self { way }
    }

    /// Reports that the service is ready.
    pub(crate) fn ready(&self) {
        self.tell("READY=1");
    }

    /// Resets the watchdog. Call more often than WatchdogSec.
    pub(crate) fn alive(&self) {
        self.tell("WATCHDOG=1");
    }

    pub(crate) fn stopping(&self) {
        self.tell("STOPPING=1");
    }

    /// Sets the line that `systemctl status` shows.
    pub(crate) fn status(&self, line: &str) {
        self.tell(&format!("STATUS={line}"));
    }

    fn tell(&self, text: &str) {
        if let Some((socket, address)) = &self.way {
            // A lost message is harmless, because the watchdog notices a failure.
            let _ = socket.send_to_addr(text.as_bytes(), address);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_manager_hears_what_is_told_and_does_not_delay_the_daemon() {
        let dir = tempfile::tempdir().expect("dir");
        let path = dir.path().join("notify");
        let hidden = format!("echotank-test-{}", std::process::id());
        let address = SocketAddr::from_abstract_name(&hidden).expect("a name");
        for (manager, name) in [
            (
                UnixDatagram::bind(&path).expect("bound"),
                path.to_str().expect("text").to_owned(),
            ),
            (
                UnixDatagram::bind_addr(&address).expect("bound"),
                format!("@{hidden}"),
            ),
        ] {
            let notify = Notify::to(Some(&name));
            notify.ready();
            notify.status("pinging");
            let mut buffer = [0; 64];
            for want in ["READY=1", "STATUS=pinging"] {
                let len = manager.recv(&mut buffer).expect("told");
                assert_eq!(&buffer[..len], want.as_bytes());
            }
        }
        // The manager reads no more: its queue is full after some messages.
        let path = dir.path().join("stalled");
        let _manager = UnixDatagram::bind(&path).expect("bound");
        let notify = Notify::to(path.to_str());
        (0..10_000).for_each(|_| notify.alive());
        Notify::to(None).alive();
        Notify::to(Some("/no/such/socket")).alive();
    }

    /// Without `systemd-analyze` only the required keys are checked.
    #[test]
    fn systemd_finds_nothing_wrong_with_the_unit() {
        let unit = include_str!("../../../packaging/echotank.service");
        for line in [
            "Type=notify",
            "WatchdogSec=30",
            "LimitRTPRIO=50",
            "LimitMEMLOCK=infinity",
            "User=echotank",
        ] {
            assert!(unit.lines().any(|l| l == line), "{line}");
        }
        let dir = tempfile::tempdir().expect("dir");
        let path = dir.path().join("echotank.service");
        // The unit's binary and its manual page are not installed on the build machine.
        let lint = |unit: &str| {
            let unit = unit.replace("ExecStart=/usr/bin/echotank", "ExecStart=/bin/true");
            std::fs::write(&path, unit).expect("written");
            let mut systemd = std::process::Command::new("systemd-analyze");
            let done = systemd
                .args(["verify", "--man=no"])
                .arg(&path)
                .output()
                .ok()?;
            let said = String::from_utf8_lossy(&done.stderr);
            // The tool also checks the machine's other units.
            let ours = said.lines().filter(|l| l.contains("echotank.service"));
            Some(ours.map(str::to_owned).collect::<Vec<_>>())
        };
        if let Some(found) = lint(unit) {
            assert_eq!(found, Vec::<String>::new());
            let wrong = lint(&unit.replace("WatchdogSec", "WatchDogSec")).expect("as before");
            assert_eq!(wrong.len(), 1, "{wrong:?}");
        }
    }
}
