//! Pings of the first sonar of a rig, on the virtual time of its navigation or on a given trajectory.

use std::path::Path;
use std::sync::Arc;

use echotank_config::spec::{NavMode, RigSpec};
use echotank_core::frames::Trajectory;
use echotank_core::navigation::NavState;
use echotank_core::ping::PingPlan;
use echotank_core::settings::SonarSettings;
use echotank_core::time::UtcNs;
use echotank_nav::Coverage;
use echotank_ping::rig::{PingSlot, Rig};
use echotank_ping::{self as ping, PingOrder, Schedule};
use echotank_runtime::clock::VirtualClock;
use echotank_runtime::io::nav::{NavInputs, ReadNav};

/// Rig with its navigation. It computes the pings of the first sonar in order.
pub struct LoggedPings {
    pub rig: Rig,
    pub slot: PingSlot,
    /// Time of the first position.
    pub first_utc: UtcNs,
    inputs: NavInputs,
    schedule: Schedule,
    settings: SonarSettings,
}

impl LoggedPings {
    /// Opens a rig. `None` if the navigation has no position. Call inside a thread pool.
    pub fn open(spec: &RigSpec) -> Result<Option<Self>, String> {
        let nav = ReadNav::read(&spec.nav).map_err(|e| e.to_string())?;
        let spec = &RigSpec {
            nav: nav.spec.clone(),
            ..spec.clone()
        };
        let mut rig = echotank_runtime::rig::open(spec).map_err(|e| e.to_string())?;
        rig.make_starting_engines();
        let clock = Arc::new(VirtualClock::default());
        let mut inputs = NavInputs::start(nav, clock).map_err(|e| e.to_string())?;
        let first_utc = loop {
            match rig.history.first_usable_utc() {
                Some(first_utc) => break first_utc,
                None if !inputs.pull_next(&mut rig.history) => return Ok(None),
                None => {}
            }
        };
        Ok(Some(Self {
            slot: rig.slot(0),
            schedule: Schedule::starting_at(first_utc, rig.medium().sound_speed_m_per_s),
            settings: spec.sonars[0].settings,
            rig,
            first_utc,
            inputs,
        }))
    }

    /// Order of the next ping of the schedule.
    pub fn next_order(&mut self) -> Result<PingOrder, String> {
        let settings = self.settings;
        self.schedule
            .due(self.schedule.next_utc(), |_| settings)
            .ok_or_else(|| "the sonar does not ping".into())
    }

    /// Reads the navigation of `order`. Returns false if the navigation ends before.
    pub fn cover(&mut self, order: &PingOrder) -> bool {
        let end = order.transmit_utc.plus_s(self.rig.window_s(0, order));
        while self.rig.history.coverage(order.transmit_utc, end) != Coverage::Ready {
            if !self.inputs.pull_next(&mut self.rig.history) {
                return false;
            }
        }
        true
    }

    /// Computes a covered ping into the slot.
    pub fn make(&mut self, order: &PingOrder) -> Result<(), String> {
        let (rig, slot) = (&mut self.rig, &mut self.slot);
        ping::make_ping(rig, 0, order, NavMode::Settle, order.transmit_utc, slot)
            .map(|_| ())
            .map_err(|e| format!("{e:?}"))
    }

    /// The next ping of a log that is long enough.
    pub fn next_ping(&mut self) -> PingOrder {
        let order = self.next_order().expect("due");
        assert!(self.cover(&order), "the log is long enough");
        self.make(&order).expect("covered");
        order
    }
}

/// Order of a ping at the epoch, at five pings a second.
pub fn order(ping_number: u32, settings: SonarSettings) -> PingOrder {
    PingOrder {
        ping_number,
        transmit_utc: UtcNs(0),
        settings,
        period_s: 0.2,
    }
}

/// Plan of the first sonar's ping on `trajectory`, with an absorption of 0.05 dB/m.
pub fn plan_on(
    trajectory: Trajectory,
    rig: &RigSpec,
    ping_number: u32,
    settings: SonarSettings,
) -> PingPlan {
    let sonar = &rig.sonars[0];
    let mut plan = ping::blank(0, sonar, &rig.medium, 0.05);
    plan.trajectory = trajectory;
    let order = order(ping_number, settings);
    ping::fill(&mut plan, sonar, &order, NavState::default(), UtcNs(0));
    plan
}

/// Side-scan sonar of 400 kHz over a plane, with additional configuration lines: `receiver` of `[sonar.receiver]`, `tables` after
/// `[sonar.ping]`, and `model` of `[sonar.model]`. Without other lines it has neither filter nor noise, and omnidirectional elements.
pub fn small_rig(elements: usize, receiver: &str, tables: &str, model: &str) -> RigSpec {
    let unless = |lines: &str, key: &str, line: &'static str| match lines.contains(key) {
        true => "",
        false => line,
    };
    let filter = unless(receiver, "rx_filter", "rx_filter = \"none\"");
    let gridded = receiver.contains("\"fir\"") && !model.contains("paper-eq21");
    let noise = unless(receiver, "noise_db", "noise_db = \"none\"");
    let path = unless(model, "path", "path = \"polyline\"");
    let doppler = unless(model, "doppler", "doppler = \"stretch\"");
    let synthesis = unless(
        model,
        "synthesis",
        match gridded {
            true => "synthesis = \"gridded-1d\"",
            false => "synthesis = \"direct\"",
        },
    );
    let error_check = unless(model, "error_check", "error_check = false");
    let text = format!(
        r#"
[[nav.source]]
name = "gnss"
kind = "udp"
listen = "127.0.0.1:10110"
[scene.seabed]
shape = "plane"
depth_m = 40.0
density_per_m2 = 1.0
[[sonar]]
name = "main"
[sonar.pulse]
kind = "lfm"
center_frequency_khz = 400.0
bandwidth_khz = 30.0
duration_ms = 2.0
[[sonar.transmit]]
name = "tx"
[[sonar.receive]]
name = "rx"
elements = {elements}
spacing_m = 0.002
element_pattern = "omnidirectional"
[sonar.receiver]
sample_rate_khz = 60.0
{filter}
{noise}
{receiver}
[sonar.ping]
range_m = 30.0
rate_hz = 5.0
source_level_db = 200.0
{tables}
[sonar.model]
{path}
{doppler}
{synthesis}
{error_check}
{model}
"#
    );
    echotank_runtime::config_files::parse(&text, Path::new(".")).expect("a good configuration")
}
