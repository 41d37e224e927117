//! One ping in nine steps: [`make_ping`] is the function to read first.
//!
//! In: an order of a ping, the navigation and the scene. Out: a [`PingSlot`] with the plan of the ping and everything it made. Nothing here fails
//! but for missing navigation, nothing logs, and nothing allocates after the first ping at the largest settings, but for the predicted errors of a
//! method selection over few scatterers: it counts. Work is split by
//! element and by beam, and no floating-point sum crosses threads, so the samples are the same bits for any number of threads.

use echotank_config::spec::{NavMode, StampSpec};
use echotank_core::navigation::NavState;
use echotank_core::ping::{OverloadState, SensorState};
use echotank_core::time::UtcNs;
use echotank_nav::NavGap;

use crate::faults::PingMark;
use crate::plan;
use crate::rig::{PingSlot, Rig};
use crate::schedule::PingOrder;
use crate::view;

/// Makes the ping `order` of sonar `sonar` in `slot`, or says what the navigation lacks. `host_utc` is the host's time at the pulse.
pub fn make_ping(
    rig: &mut Rig,
    sonar: usize,
    order: &PingOrder,
    mode: NavMode,
    host_utc: UtcNs,
    slot: &mut PingSlot,
) -> Result<(), NavGap> {
    motion(rig, sonar, order, mode, host_utc, slot)?;
    gather(rig, sonar, slot);
    finish_ping(rig, sonar, slot);
    Ok(())
}

/// As [`make_ping`], with the tolerance of a degradation level: 0 is the configured one.
pub fn make_degraded_ping(
    rig: &mut Rig,
    level: usize,
    sonar: usize,
    order: &PingOrder,
    mode: NavMode,
    host_utc: UtcNs,
    slot: &mut PingSlot,
) -> Result<(), NavGap> {
    let tolerance = rig.sonars[sonar].swap(level);
    let made = make_ping(rig, sonar, order, mode, host_utc, slot);
    let unit = &mut rig.sonars[sonar];
    unit.swap(level);
    if level > 0
        && made.is_ok()
        && let Some(method_selector) = &mut unit.method_selector
    {
        // Later pings with the configured tolerance have the same methods as if this one had it.
        method_selector.before_ping(order.ping_number, &mut unit.pipeline);
        method_selector.after_ping(&slot.plan, &rig.scatterers, None);
    }
    slot.output.overload_state = OverloadState {
        tolerance,
        put_off_s: 0.0,
    };
    made
}

/// Makes the rest of a ping that has its motion and its scatterers.
pub fn finish_ping(rig: &mut Rig, sonar: usize, slot: &mut PingSlot) {
    choose_path(rig, sonar, slot);
    insonify(rig, sonar, slot);
    synthesise(rig, sonar, slot);
    predict(rig, sonar, slot);
    receive(rig, sonar, slot);
    form(rig, sonar, slot);
    learn(rig, sonar, slot);
}

/// The plan of the ping: how the platform moves while it listens, and with which methods and faults it is made.
pub fn motion(
    rig: &mut Rig,
    sonar: usize,
    order: &PingOrder,
    mode: NavMode,
    host_utc: UtcNs,
    slot: &mut PingSlot,
) -> Result<(), NavGap> {
    rig.place_scene();
    let window_s = rig.motion_s(sonar, order);
    let trajectory = &mut slot.plan.trajectory;
    let mut nav = rig
        .history
        .motion(order.transmit_utc, window_s, mode, trajectory)?;
    let sensor = sensor_state(rig, sonar, &mut nav);
    let stamp_utc = match rig.spec.nav.stamp {
        StampSpec::Log => order.transmit_utc,
        StampSpec::Host => host_utc,
    };
    let mark = PingMark::of(sonar, order);
    let stamp_utc = stamp_utc.plus_s(rig.faults.stamp_error_s(mark));
    let unit = &mut rig.sonars[sonar];
    if let Some(method_selector) = &mut unit.method_selector {
        method_selector.before_ping(order.ping_number, &mut unit.pipeline);
        slot.plan.model = unit.pipeline.model();
    }
    rig.faults.elements(mark, unit.pipeline.faults_mut());
    slot.plan.sensor = sensor;
    slot.plan.sound_speed_m_per_s = rig.spec.medium.sound_speed_m_per_s;
    plan::fill(&mut slot.plan, &unit.spec, order, nav, stamp_utc);
    rig.set_water(&mut slot.plan);
    Ok(())
}

/// Place of the sonar. Sets the heave of `nav` where it is the displacement from a configured depth.
fn sensor_state(rig: &Rig, sonar: usize, nav: &mut NavState) -> SensorState {
    let spec = &rig.spec.nav;
    if let Some(still_depth_m) = spec.heave_from_depth_m {
        nav.heave_down_m = -nav.height_m - still_depth_m;
    }
    let at_m = rig.sonars[sonar].center_m(&nav.pose);
    let (latitude_rad, longitude_rad) = match rig.history.origin() {
        Some(plane) => plane.geodetic_rad(at_m.x, at_m.y),
        None => (nav.latitude_rad, nav.longitude_rad),
    };
    let altitude_m = rig.scene.seabed_down_m(at_m.x, at_m.y);
    SensorState {
        latitude_rad,
        longitude_rad,
        depth_m: at_m.z,
        altitude_m: altitude_m
            .map(|down_m| down_m - at_m.z)
            .filter(|a| *a > 0.0),
        still_depth_m: spec.has_depth().then_some(-nav.height_m - nav.heave_down_m),
    }
}

/// The scatterers within the footprints of the ping's arrays, where its water shows them.
pub fn gather(rig: &mut Rig, sonar: usize, slot: &mut PingSlot) {
    let unit = &mut rig.sonars[sonar];
    rig.scatterers.truncate_to_scene();
    let footprints = unit.pipeline.footprints(&slot.plan);
    let footprints = match &mut rig.multipath {
        Some(multipath) => multipath.widen(&slot.plan, footprints),
        None => footprints,
    };
    slot.output.scene = rig.scene.gather(footprints, &mut rig.scatterers);
    if let Some((stage, view)) = &mut unit.simplify {
        view::view(&unit.spec, &slot.plan, view);
        // The seabed's come first; points and targets stay.
        let seabed = slot.output.scene.scatterers as usize;
        rig.simplify_counts = stage.thin(&mut rig.scatterers, seabed, view);
    }
    let mut scatterers = std::mem::take(&mut rig.scatterers);
    rig.append_moving(&slot.plan, &mut scatterers, &mut slot.output.scene);
    rig.add_surface(&slot.plan, &mut scatterers, &mut slot.output.scene);
    rig.append_volume(&slot.plan, &mut scatterers, &mut slot.output.scene);
    rig.propagate(&mut slot.plan, &mut scatterers, &mut slot.output.scene);
    rig.scatterers = scatterers;
    let unit = &mut rig.sonars[sonar];
    let finder = &mut unit.range_floors;
    finder.find(&unit.spec, &mut slot.plan, &rig.scatterers);
}

/// The path model that keeps the tolerance with the motion of this ping, where the configuration leaves it to the method selection.
pub fn choose_path(rig: &mut Rig, sonar: usize, slot: &mut PingSlot) {
    if let Some(method_selector) = &mut rig.sonars[sonar].method_selector {
        method_selector.at_ping(&mut slot.plan, &rig.scatterers);
    }
}

/// The way of the sound from the transmitters to every scatterer.
pub fn insonify(rig: &mut Rig, sonar: usize, slot: &mut PingSlot) {
    let pipeline = &mut rig.sonars[sonar].pipeline;
    pipeline.insonify(&slot.plan, &rig.scatterers, &mut slot.output);
}

/// The sum of the echoes at every element.
pub fn synthesise(rig: &mut Rig, sonar: usize, slot: &mut PingSlot) {
    let PingSlot { plan, output } = slot;
    let pipeline = &mut rig.sonars[sonar].pipeline;
    pipeline.synthesise(plan, &rig.scatterers, output);
}

/// The predicted error of a method selection, from the samples of the elements.
pub fn predict(rig: &mut Rig, sonar: usize, slot: &mut PingSlot) {
    let unit = &mut rig.sonars[sonar];
    let PingSlot { plan, output } = slot;
    if let Some(method_selector) = &mut unit.method_selector {
        let is_direct = unit.pipeline.is_direct_instead();
        method_selector.after_synthesis(plan, &rig.scatterers, &output.elements, is_direct);
    }
}

/// The receiver of every element: noise, gain, converter and faults.
pub fn receive(rig: &mut Rig, sonar: usize, slot: &mut PingSlot) {
    let pipeline = &mut rig.sonars[sonar].pipeline;
    pipeline.receive(&slot.plan, &mut slot.output);
}

/// Side-scan lines, beams and soundings.
pub fn form(rig: &mut Rig, sonar: usize, slot: &mut PingSlot) {
    let PingSlot { plan, output } = slot;
    rig.sonars[sonar].pipeline.form(plan, output);
}

/// What the method selection takes from the ping for later ones.
pub fn learn(rig: &mut Rig, sonar: usize, slot: &mut PingSlot) {
    let unit = &mut rig.sonars[sonar];
    let PingSlot { plan, output } = slot;
    if let Some(method_selector) = &mut unit.method_selector {
        output.methods = method_selector.mark();
        method_selector.after_ping(plan, &rig.scatterers, output.error_check.as_ref());
    }
}

impl Rig {
    /// Selects the methods of the first pings for `order`, where the configuration leaves them to the selection and navigation is there. To be called
    /// before any ping.
    pub fn select_first_methods(&mut self, sonar: usize, order: &PingOrder) {
        if self.sonars[sonar].method_selector.is_none() {
            return;
        }
        let mut slot = self.slot(sonar);
        let mode = self.spec.nav.mode;
        if self
            .prepare(sonar, order, mode, order.transmit_utc, &mut slot)
            .is_ok()
        {
            let unit = &mut self.sonars[sonar];
            if let Some(method_selector) = &mut unit.method_selector {
                method_selector.select_first(&slot.plan, &self.scatterers, &mut unit.pipeline);
            }
            for level in &mut unit.looser {
                if let Some(method_selector) = &mut level.method_selector {
                    method_selector.select_first(&slot.plan, &self.scatterers, &mut level.pipeline);
                }
            }
        }
    }

    /// Lets the method selection examine a ping that is not made, as if it had been: of a replay that begins later.
    ///
    /// # Errors
    /// The navigation has a gap at the ping.
    pub fn examine(
        &mut self,
        sonar: usize,
        order: &PingOrder,
        mode: NavMode,
        slot: &mut PingSlot,
    ) -> Result<(), NavGap> {
        if self.sonars[sonar].method_selector.is_none() {
            return Ok(());
        }
        motion(self, sonar, order, mode, order.transmit_utc, slot)?;
        let selector = &self.sonars[sonar].method_selector;
        if selector.as_ref().is_some_and(|s| s.examines(&slot.plan)) {
            gather(self, sonar, slot);
        }
        if let Some(method_selector) = &mut self.sonars[sonar].method_selector {
            method_selector.after_ping(&slot.plan, &self.scatterers, None);
        }
        Ok(())
    }

    /// Makes the plan of a ping and gathers its scatterers, without the ping itself.
    pub fn prepare(
        &mut self,
        sonar: usize,
        order: &PingOrder,
        mode: NavMode,
        host_utc: UtcNs,
        slot: &mut PingSlot,
    ) -> Result<(), NavGap> {
        motion(self, sonar, order, mode, host_utc, slot)?;
        gather(self, sonar, slot);
        Ok(())
    }
}
