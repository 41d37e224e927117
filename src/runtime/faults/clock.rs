//! Faults of the clock outputs: missing pulses per second and ZDA sentences with the wrong time.

use echotank_config::spec::FaultKind;
use echotank_core::time::UtcNs;
use echotank_ping::faults::{Faults, Moment, Standing};

use crate::io::nav::output::ClockFaults;

impl ClockFaults for Faults {
    fn pulse_is_lost(&self, second: UtcNs) -> bool {
        let mut lost = false;
        let moment = Moment::of_second(second);
        let of_pulse = |s: &Standing| matches!(s.spec.kind, FaultKind::PulseLost);
        self.each(moment, of_pulse, |standing, _, strength| {
            lost = true;
            self.log(standing, self.injection(standing, moment, strength));
        });
        lost
    }

    fn zda_is_off_s(&self, second: UtcNs) -> f64 {
        let mut off_s = 0.0;
        let moment = Moment::of_second(second);
        let of_zda = |s: &Standing| matches!(s.spec.kind, FaultKind::WrongZda { .. });
        self.each(moment, of_zda, |standing, _, strength| {
            if let FaultKind::WrongZda { s } = standing.spec.kind {
                off_s += s * strength;
            }
            self.log(standing, self.injection(standing, moment, strength));
        });
        off_s
    }
}
