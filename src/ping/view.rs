//! Geometry and patterns of a ping's arrays, from which the scene selects scatterers.

use glam::DVec3;

use echotank_config::spec::SonarSpec;
use echotank_core::arrays::Pattern;
use echotank_core::ping::PingPlan;
use echotank_scene::simplify::energy::{Beam, View};
use echotank_synthesis::echo::levels::Directivity;

/// Transmit and receive arrays rotated by less than this against each other share their axes. Otherwise the view uses the transmitter's
/// pattern alone, which omits fewer scatterers.
const PARALLEL_RAD: f64 = 1e-3;

/// Sets the position and beams of `view`: one beam per receive array, from its element's pattern and the pattern of its transmitter. Other
/// fields of the view are unchanged.
pub fn view(spec: &SonarSpec, plan: &PingPlan, view: &mut View) {
    let pose = plan.trajectory.pose_at(0.0);
    let wavelength_m = plan.sound_speed_m_per_s / plan.pulse.center_frequency_hz;
    let face = |pattern: &Pattern| Directivity::new(pattern, wavelength_m).face();
    view.apex_m = pose.position_m;
    view.beams.clear();
    view.beams.extend(spec.receive.iter().map(|array| {
        let transmit = &spec.transmit[array.transmit];
        // Axes of the narrower of the two faces; an omnidirectional face has no axes.
        let mounting = match transmit.pattern {
            Pattern::Omnidirectional => &array.mounting,
            Pattern::Rectangle { .. } | Pattern::Part { .. } => &transmit.mounting,
        };
        let turn = pose.world_from_body * mounting.body_from_array;
        let apart_rad = mounting
            .body_from_array
            .angle_between(array.mounting.body_from_array);
        let transmit_face = face(&transmit.pattern);
        let receive_face = match apart_rad < PARALLEL_RAD {
            true => face(&array.envelope_pattern()),
            false => (0.0, 0.0, false),
        };
        Beam {
            along: turn * DVec3::X,
            across: turn * DVec3::Y,
            boresight: turn * DVec3::Z,
            lengths: [transmit_face.0, receive_face.0],
            widths: [transmit_face.1, receive_face.1],
            baffled: transmit_face.2 || receive_face.2,
        }
    }));
}
