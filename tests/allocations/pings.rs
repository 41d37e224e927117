//! Test that the ping path does not allocate after warm-up. It is a separate binary, because it counts with the global allocator.

use echotank_config::spec::Density;
use echotank_core::model::Synthesis;
use echotank_ping::threads::pool;
use echotank_testing::allocations;
use echotank_testing::pings::LoggedPings;

/// Number of allocations in each of the last `watched` pings of `count`.
fn allocations_per_ping(file: &str, threads: usize, count: usize, watched: usize) -> Vec<u64> {
    let path = echotank_testing::repository()
        .join("hil-configs")
        .join(file);
    let mut spec = echotank_runtime::config_files::load(&path).expect("a good configuration");
    // A moving ship needs new tiles. A static scene shows the allocations of the ping only.
    spec.scene
        .seabed
        .iter_mut()
        .for_each(|seabed| seabed.density = Density::PerM2(0.1));
    for sonar in &mut spec.sonars {
        // Another selection of methods creates another pipeline during the pings.
        sonar.synthesis.auto = Default::default();
        sonar.model.synthesis = Synthesis::Direct;
        sonar.model.cull_db = Some(-24.0);
    }
    let pool = pool(threads).expect("threads");
    pool.install(|| {
        let mut pings = LoggedPings::open(&spec).expect("rig").expect("nav");
        let mut counted = Vec::new();
        for ping in 0..count {
            let order = pings.next_order().expect("due");
            assert!(pings.cover(&order), "the log is long enough");
            let before = allocations::in_all_threads();
            pings.make(&order).expect("covered");
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
        // Over a seabed, new tiles appear as the ship moves, and a ping may have more scatterers than all before. Both rarely grow
        // a buffer, and nothing else allocates.
        let seabed = allocations_per_ping("quickstart.toml", threads, 36, 20);
        let quiet = seabed.iter().filter(|&&n| n == 0).count();
        assert!(quiet >= 10, "quickstart, {threads} threads: {seabed:?}");
    }
}
