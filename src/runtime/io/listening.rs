//! Ports on which this process listens. No client may direct records to these ports. Ports that other computers can reach are logged at start.

use std::net::{IpAddr, SocketAddr, UdpSocket};
use std::sync::{Mutex, PoisonError};

use tracing::warn;

/// Own ports. A poisoned lock is usable, because a vector of plain data stays consistent after a panic.
static OWN: Mutex<Vec<SocketAddr>> = Mutex::new(Vec::new());

/// A port in [`OWN`]; dropping it removes the port.
#[derive(Debug)]
pub(crate) struct Listening(SocketAddr);

impl Listening {
    /// Registers a bound address. `what` names the service in the warning that other computers can reach it.
    pub(crate) fn at(what: &str, address: SocketAddr) -> Self {
        if !address.ip().is_loopback() {
            warn!(what, %address, "other computers can connect; use it in a trusted network only");
        }
        own().push(address);
        Self(address)
    }
}

impl Drop for Listening {
    fn drop(&mut self) {
        let mut own = own();
        if let Some(k) = own.iter().position(|address| *address == self.0) {
            own.swap_remove(k);
        }
    }
}

fn own() -> std::sync::MutexGuard<'static, Vec<SocketAddr>> {
    OWN.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Whether a datagram or connection to this address reaches a port of this process.
pub(crate) fn is_own(address: SocketAddr) -> bool {
    let ip = address.ip().to_canonical();
    let same_port: Vec<_> = own()
        .iter()
        .filter(|own| own.port() == address.port())
        .map(|own| own.ip().to_canonical())
        .collect();
    same_port.contains(&ip)
        || !same_port.is_empty() && ip.is_unspecified()
        || same_port.iter().any(IpAddr::is_unspecified) && is_of_this_computer(ip)
}

/// Whether `ip` is an address of this computer: only such addresses can be bound.
fn is_of_this_computer(ip: IpAddr) -> bool {
    UdpSocket::bind((ip, 0)).is_ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_port_is_own_for_as_long_as_it_is_held() {
        let at = |text: &str| text.parse::<SocketAddr>().expect("an address");
        // Ports below 1024, which no other test binds.
        let held = [
            Listening::at("a", at("127.0.0.1:7")),
            Listening::at("b", at("0.0.0.0:9")),
        ];
        for (address, want) in [
            ("127.0.0.1:7", true),
            ("0.0.0.0:7", true),
            ("[::ffff:127.0.0.1]:7", true),
            ("127.0.0.2:7", false),
            ("127.0.0.9:9", true),
            ("192.0.2.1:9", false),
            ("127.0.0.1:8", false),
        ] {
            assert_eq!(is_own(at(address)), want, "{address}");
        }
        drop(held);
        assert!(!is_own(at("127.0.0.1:7")) && !is_own(at("127.0.0.9:9")));
    }
}
