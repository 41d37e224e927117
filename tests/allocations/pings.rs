//! The ping path does not allocate after warm-up. A separate binary, because it counts with the global allocator.

use echotank_testing::allocations;
use std::sync::Arc;

use echotank_config::spec::{Density, NavMode};
use echotank_core::model::Synthesis;
use echotank_nav::Coverage;
use echotank_ping::Schedule;
use echotank_ping::rig::pool;
use echotank_runtime::clock::VirtualClock;
use echotank_runtime::io::nav::NavInputs;

/// Allocations in each of the last pings of `count`.
fn allocations_per_ping(file: &str, threads: usize, count: usize, watched: usize) -> Vec<u64> {
    let path = echotank_testing::repository()
        .join("hil-configs")
        .join(file);
    let mut spec = echotank_runtime::config_files::load(&path).expect("a good configuration");
    // A moving ship needs new tiles; a static scene shows the ping alone.
    spec.scene
        .seabed
        .iter_mut()
        .for_each(|seabed| seabed.density = Density::PerM2(0.5));
    for sonar in &mut spec.sonars {
        // Another selection is another pipeline, made beside the pings.
        sonar.synthesis.auto = Default::default();
        sonar.model.synthesis = Synthesis::Direct;
        sonar.model.cull_db = Some(-24.0);
    }
    let pool = pool(threads).expect("threads");
    pool.install(|| {
        let mut rig = echotank_runtime::rig::open(&spec).expect("rig");
        let mut inputs =
            NavInputs::open(&spec.nav, Arc::new(VirtualClock::default())).expect("nav");
        while rig.history.first_usable_utc().is_none() {
            assert!(inputs.pull_next(&mut rig.history));
        }
        let first = rig.history.first_usable_utc().expect("nav");
        let mut schedule = Schedule::starting_at(first, rig.medium().sound_speed_m_per_s);
        let mut slot = rig.slot(0);
        let settings = spec.sonars[0].settings;
        let mut counted = Vec::new();
        for ping in 0..count {
            let order = schedule
                .due(schedule.next_utc(), |_| settings)
                .expect("due");
            let end = order.transmit_utc.plus_s(rig.window_s(0, &order));
            while rig.history.coverage(order.transmit_utc, end) != Coverage::Ready {
                assert!(inputs.pull_next(&mut rig.history), "the log is long enough");
            }
            let before = allocations::in_all_threads();
            echotank_ping::make_ping(
                &mut rig,
                0,
                &order,
                NavMode::Settle,
                order.transmit_utc,
                &mut slot,
            )
            .expect("covered");
            if ping >= count - watched {
                counted.push(allocations::in_all_threads() - before);
            }
        }
        counted
    })
}

#[test]
fn a_ping_allocates_nothing_after_warm_up() {
    let _alone = allocations::alone();
    for threads in [1, 2] {
        let points = allocations_per_ping("points.toml", threads, 8, 4);
        assert_eq!(points, [0; 4], "points, {threads} threads");
        // Over a seabed new tiles appear as the ship moves on, and a ping may contain more scatterers than any before: both rarely grow a
        // buffer; nothing else does.
        let seabed = allocations_per_ping("quickstart.toml", threads, 60, 20);
        let quiet = seabed.iter().filter(|&&n| n == 0).count();
        assert!(quiet >= 10, "quickstart, {threads} threads: {seabed:?}");
    }
}
