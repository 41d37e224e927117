//! Fault injection outside the ping: on the link to the clients ([`link`]), in navigation ([`nav`]) and in the clock outputs.

mod clock;
pub mod link;
pub mod nav;
mod nav_bytes;

#[cfg(test)]
mod testing {
    use std::path::Path;

    use echotank_config::spec::NavInputSpec;
    use echotank_ping::faults::Faults;

    /// Faults of a rig with one sonar and two navigation sources: the live "gnss" and the recorded "mru".
    pub(super) fn faults() -> Faults {
        let folder = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../hil-configs"));
        let rig =
            crate::config_files::load(&folder.join("points.toml")).expect("a sound configuration");
        let mut sources = vec![rig.nav.sources[0].clone(), rig.nav.sources[0].clone()];
        sources[0].name = "gnss".to_owned();
        sources[0].input = NavInputSpec::Udp {
            listen: ([127, 0, 0, 1], 0).into(),
            multicast: None,
        };
        sources[1].name = "mru".to_owned();
        Faults::new(&rig.sonars, &sources)
    }
}
