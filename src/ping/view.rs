//! How a ping's transmitters and elements see the scene, for the choice of scatterers.

use glam::DVec3;

use echotank_config::spec::SonarSpec;
use echotank_core::flow::{Pattern, PingPlan};
use echotank_scene::simplify::energy::{Beam, View};

/// Transmit and receive arrays turned less than this against each other share their axes; others are seen with the transmitter's pattern
/// alone, which leaves out less.
const PARALLEL_RAD: f64 = 1e-3;

/// One beam for each receive array, into `view`: its element's pattern with that of the transmitter it listens to, since every output is made
/// of elements. What the view holds besides place and beams stays.
pub fn view(spec: &SonarSpec, plan: &PingPlan, view: &mut View) {
    let pose = plan.trajectory.pose_at(0.0);
    let wavelength_m = plan.sound_speed_m_per_s / plan.pulse.center_frequency_hz;
    let face = |pattern: &Pattern| match *pattern {
        Pattern::Omnidirectional => (0.0, 0.0, false),
        Pattern::Rectangle {
            length_m,
            width_m,
            baffled,
        }
        | Pattern::Part {
            length_m,
            width_m,
            baffled,
            ..
        } => (length_m / wavelength_m, width_m / wavelength_m, baffled),
    };
    view.apex_m = pose.position_m;
    view.beams.clear();
    view.beams.extend(spec.receive.iter().map(|array| {
        let transmit = &spec.transmit[array.transmit];
        // Axes of the narrower of the two: an omnidirectional face has none of its own.
        let mounting = match transmit.pattern {
            Pattern::Omnidirectional => &array.mounting,
            Pattern::Rectangle { .. } | Pattern::Part { .. } => &transmit.mounting,
        };
        let turn = pose.world_from_body * mounting.body_from_array;
        let apart_rad = mounting
            .body_from_array
            .angle_between(array.mounting.body_from_array);
        let sent = face(&transmit.pattern);
        let heard = match apart_rad < PARALLEL_RAD {
            true => face(&array.element_pattern),
            false => (0.0, 0.0, false),
        };
        Beam {
            along: turn * DVec3::X,
            across: turn * DVec3::Y,
            boresight: turn * DVec3::Z,
            lengths: [sent.0, heard.0],
            widths: [sent.1, heard.1],
            baffled: sent.2 || heard.2,
        }
    }));
}
