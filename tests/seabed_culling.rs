//! What a ping asks of the scene holds everything that the walk over the scatterers keeps.

use std::path::Path;
use std::sync::Arc;

use echotank::config;
use echotank::config::spec::NavMode;
use echotank::echo::culling::left_out_share;
use echotank::echo::levels::Directivity;
use echotank::flow::Mounting;
use echotank::frames::Pose;
use echotank::io::nav::NavInputs;
use echotank::nav::Coverage;
use echotank::ping::Schedule;
use echotank::run::rig::{Rig, pool};
use echotank::time::VirtualClock;
use glam::DVec3;

/// Equidistributed over k in each coordinate (Weyl).
fn weyl(k: u32, coordinate: usize) -> f64 {
    (f64::from(k) * [0.754_877_666, 0.569_840_291, 0.327_0][coordinate]).fract()
}

/// On a real log of a ship in a swell, whose attitude changes by degrees within a listening window.
#[test]
fn a_footprint_holds_every_place_that_an_element_hears_above_the_floor() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("hil-configs/quickstart.toml");
    let mut spec = config::load(&path).expect("a good configuration");
    spec.scene.seabed = None;
    spec.scene.targets = None;
    let sonar = spec.sonars[0].clone();
    pool(1).expect("thread").install(|| {
        let mut rig = Rig::open(&spec).expect("rig");
        let mut inputs =
            NavInputs::open(&spec.nav, Arc::new(VirtualClock::default())).expect("nav");
        while rig.history.first_usable_utc().is_none() {
            assert!(inputs.pull_next(&mut rig.history));
        }
        let first = rig.history.first_usable_utc().expect("nav");
        let mut schedule = Schedule::starting_at(first, rig.medium().sound_speed_m_per_s);
        let mut slot = rig.slot(0);
        let (mut heard, mut asked, mut tried) = (0, 0, 0);
        for ping in 0..10 {
            let order = schedule
                .due(schedule.next_utc(), |_| sonar.settings)
                .expect("due");
            let end = order.transmit_utc.plus_s(rig.window_s(0, &order));
            while rig.history.coverage(order.transmit_utc, end) != Coverage::Ready {
                assert!(inputs.pull_next(&mut rig.history), "the log is long enough");
            }
            rig.make(0, &order, NavMode::Settle, order.transmit_utc, &mut slot)
                .expect("covered");
            let plan = &slot.plan;
            let footprints = rig.sonars[0].pipeline.footprints(plan).to_vec();
            assert_eq!(footprints.len(), sonar.receive.len());
            let c = plan.sound_speed_m_per_s;
            let wavelength_m = c / plan.pulse.center_frequency_hz;
            let floor = 10f64.powf(plan.model.cull_db.expect("culled") / 20.0);
            let towards = |d: &Directivity, pose: &Pose, mounting: &Mounting, ray_m: DVec3| {
                let world_from_array = pose.world_from_body * mounting.body_from_array;
                let u = world_from_array.inverse() * ray_m.normalize();
                d.towards(u.x, u.y, u.z).abs()
            };
            let start = plan.trajectory.pose_at(0.0);
            for k in 0..4000 {
                let direction = DVec3::new(weyl(k, 0) - 0.5, weyl(k, 1) - 0.5, weyl(k, 2) - 0.3);
                let range_m = 5.0 + 140.0 * weyl(k + ping, 2);
                let at_m = start.position_m + direction.normalize() * range_m;
                for (array, footprint) in sonar.receive.iter().zip(&footprints) {
                    let transmit = &sonar.transmit[array.transmit];
                    let lit = Directivity::new(&transmit.pattern, wavelength_m);
                    let element = Directivity::new(&array.element_pattern, wavelength_m);
                    let out_m = at_m - start.point_m(transmit.mounting.position_m);
                    let sent = towards(&lit, &start, &transmit.mounting, out_m);
                    // When the echo comes back, to a millimetre of the platform's way.
                    let back = plan.trajectory.pose_at(2.0 * out_m.length() / c);
                    let contained = footprint.contains(at_m);
                    asked += u32::from(contained);
                    tried += 1;
                    for e in [0, array.elements - 1] {
                        let back_m = at_m - back.point_m(array.element_body_m(e));
                        let received = towards(&element, &back, &array.mounting, back_m);
                        if sent * received >= floor && out_m.length() < footprint.max_range_m {
                            heard += 1;
                            assert!(contained, "ping {ping}, {at_m}: {}", sent * received);
                        }
                    }
                }
            }
        }
        println!("{tried} places: {heard} heard at the ends of an array, {asked} asked for");
        assert!(heard > 1000, "only {heard} places were heard");
        assert!(
            asked < tried / 2,
            "{asked} of {tried} asked for: hardly anything is culled"
        );
    });
}

#[test]
fn a_floor_that_nobody_gave_costs_half_the_tolerance_and_a_decibel_more_would_cost_more() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("hil-configs");
    let text = std::fs::read_to_string(folder.join("seabed.toml")).expect("readable");
    assert!(!text.contains("\ncull_db"), "the operator gives none");
    for tolerance in [1e-2, 1e-3] {
        let asked = text.replace("tolerance = 1e-3", &format!("tolerance = {tolerance:e}"));
        let spec = config::parse(&asked, &folder).unwrap_or_else(|e| panic!("{e}"));
        let sonar = &spec.sonars[0];
        let cull_db = sonar.model.cull_db.expect("something is left out");
        let wavelength_m = spec.medium.sound_speed_m_per_s / sonar.pulse.center_frequency_hz;
        let error_of = |db: f64| {
            let mut worst = 0.0_f64;
            for array in &sonar.receive {
                let transmit = &sonar.transmit[array.transmit];
                for incidence_deg in [20.0_f64, 45.0, 70.0, 85.0] {
                    let incidence_rad = incidence_deg.to_radians();
                    let share = left_out_share(transmit, array, wavelength_m, db, incidence_rad);
                    worst = worst.max(share.sqrt());
                }
            }
            worst
        };
        let (kept, over) = (error_of(cull_db), error_of(cull_db + 1.0));
        println!("{tolerance:e}: {cull_db} dB, {kept:.2e}; a decibel more {over:.2e}");
        assert!(kept <= 0.5 * tolerance, "{kept}");
        assert!(over > 0.5 * tolerance, "{over}");
    }
    let own = text.replace("[sonar.model]", "[sonar.model]\ncull_db = -30.0");
    let spec = config::parse(&own, &folder).unwrap_or_else(|e| panic!("{e}"));
    assert_eq!(spec.sonars[0].model.cull_db, Some(-30.0));
}
