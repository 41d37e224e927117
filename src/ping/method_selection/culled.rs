//! What culling leaves out of a ping's samples, and how many pairs of scatterer and element it keeps.
//!
//! Where the operator gives no culling level, every ping has floors by range that keep [`LEFT_OUT`] of the tolerance
//! ([`crate::range_floors`]). A configured level is kept; its error is estimated on the scatterers of the ping, and, for directions that are not gathered,
//! on flat ground.

use crate::method_selection::echo_statistics::{Shares, kept_shares};
use crate::method_selection::{Culling, Scene};
use crate::range_floors::{LEFT_OUT, RangeFloorFinder};
use echotank_synthesis::echo::culling::left_out_share;

/// Where a configured level is looked at on flat ground: from near the first bottom return to grazing.
const INCIDENCES_DEG: [f64; 4] = [20.0, 45.0, 70.0, 85.0];

pub(super) fn culling(scene: &Scene) -> Culling {
    let Scene {
        spec,
        plan,
        scatterers,
        ..
    } = *scene;
    let Some(db) = spec.model.cull_db else {
        return Culling {
            db: None,
            error: 0.0,
            of: Shares::ALL,
        };
    };
    let error = match spec.synthesis.culls_by_window {
        true => LEFT_OUT * spec.synthesis.tolerance,
        false => {
            let wavelength_m = plan.sound_speed_m_per_s / plan.pulse.center_frequency_hz;
            let arrays = spec.receive.iter().flat_map(|array| {
                let transmit = &spec.transmit[array.transmit];
                INCIDENCES_DEG.map(|deg| {
                    left_out_share(transmit, array, wavelength_m, db, deg.to_radians()).sqrt()
                })
            });
            let gathered = RangeFloorFinder::default().left_out(spec, plan, scatterers, db);
            arrays.fold(gathered, f64::max)
        }
    };
    Culling {
        db: Some(db),
        error,
        of: kept_shares(spec, plan, scatterers, db),
    }
}
