//! Faults of the clock outputs: missing pulses per second and ZDA sentences with the wrong time.

use echotank_config::spec::FaultKind;
use echotank_core::time::UtcNs;
use echotank_ping::faults::{Faults, InjectionPoint, ScheduledFault};

use crate::io::nav::output::ClockFaults;

impl ClockFaults for Faults {
    fn pulse_is_lost(&self, second: UtcNs) -> bool {
        let mut lost = false;
        let point = InjectionPoint::of_second(second);
        let of_pulse = |s: &ScheduledFault| matches!(s.spec.kind, FaultKind::PulseLost);
        self.for_each_active(point, of_pulse, |fault, _, strength| {
            lost = true;
            self.log(fault, self.injection(fault, point, strength));
        });
        lost
    }

    fn zda_is_off_s(&self, second: UtcNs) -> f64 {
        let mut off_s = 0.0;
        let point = InjectionPoint::of_second(second);
        let of_zda = |s: &ScheduledFault| matches!(s.spec.kind, FaultKind::WrongZda { .. });
        self.for_each_active(point, of_zda, |fault, _, strength| {
            if let FaultKind::WrongZda { s } = fault.spec.kind {
                off_s += s * strength;
            }
            self.log(fault, self.injection(fault, point, strength));
        });
        off_s
    }
}
