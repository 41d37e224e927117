//! The automatic density on the rigs of `tools/rates`: scatterers a ping, and the time to gather them.

use std::time::Instant;

use echotank_config::spec::{RigSpec, SeabedShape};
use echotank_core::frames::Trajectory;
use echotank_core::navigation::NavState;
use echotank_core::scene::Scatterers;
use echotank_core::settings::SonarSettings;
use echotank_core::time::UtcNs;
use echotank_ping::PingOrder;
use echotank_ping::footprints::footprints;
use echotank_ping::plan::{blank, fill};
use echotank_ping::threads::pool;
use echotank_runtime::io::files::FileSystem;
use echotank_scene::Scene;
use glam::{DQuat, DVec3};

/// Between two pings at 2.5 m/s.
const ADVANCE_M: f64 = 0.15;
const PINGS: usize = 4;

/// Most scatterers and median milliseconds of a ping of each sonar, on one thread, after a first ping that makes the tiles.
fn gathered(spec: &RigSpec) -> Vec<(usize, f64)> {
    let mut scene = Scene::open(&FileSystem, &spec.scene).expect("a scene");
    let mut out = Scatterers::default();
    let of_sonar = |sonar: usize| {
        let unit = &spec.sonars[sonar];
        let mut plan = blank(sonar, unit, &spec.medium, 0.0);
        let order = PingOrder {
            ping_number: 1,
            transmit_utc: UtcNs(0),
            settings: SonarSettings {
                pinging: true,
                ..unit.settings
            },
            period_s: 0.0,
        };
        let (mut most, mut took_ms, mut areas) = (0, Vec::new(), Vec::new());
        for ping in 0..PINGS {
            let at_m = DVec3::new(ADVANCE_M * ping as f64, 0.0, 0.0);
            let turn = DQuat::from_euler(glam::EulerRot::ZYX, 0.5, 0.01, 0.02 * ping as f64);
            plan.trajectory = Trajectory::uniform(at_m, turn * DVec3::X * 2.5, turn);
            fill(&mut plan, unit, &order, NavState::default(), UtcNs(0));
            footprints(unit, &plan, &mut areas);
            let start = Instant::now();
            let counts = scene.gather(&areas, &mut out);
            if ping > 0 {
                took_ms.push(start.elapsed().as_secs_f64() * 1e3);
            }
            most = most.max(counts.scatterers as usize);
        }
        took_ms.sort_by(f64::total_cmp);
        (most, took_ms[took_ms.len() / 2])
    };
    (0..spec.sonars.len()).map(of_sonar).collect()
}

#[test]
fn every_rig_has_a_number_of_scatterers_that_it_can_use() {
    // Rig, range, depth, further settings, most scatterers of a ping of all sonars.
    let cases: [(&str, f64, f64, &[&str], usize); 9] = [
        ("seabat", 10.0, 5.0, &[], 100_000),
        ("seabat", 120.0, 40.0, &[], 100_000),
        ("wbms", 10.0, 5.0, &["sonar.pulse.duration_ms=0.2"], 100_000),
        // Above the limit even with the smallest k; docs/limits.md states it.
        ("wbms", 45.0, 12.0, &[], 130_000),
        ("edgetech", 75.0, 15.0, &[], 300_000),
        ("omniscan450", 50.0, 12.0, &[], 100_000),
        ("surveyor240", 50.0, 20.0, &[], 100_000),
        ("board", 150.0, 50.0, &[], 100_000),
        ("sidescan455", 75.0, 15.0, &[], 300_000),
    ];
    pool(1).expect("thread").install(|| {
        for (rig, range_m, depth_m, further, most) in cases {
            let path = echotank_testing::repository().join(format!("tools/rates/{rig}.toml"));
            let mut set = vec![
                format!("sonar.ping.range_m={range_m}"),
                format!("sonar.limits.range_m=[1.0, {range_m}]"),
                format!("scene.seabed.depth_m={depth_m}"),
                "sonar.ping.rate_hz=1".to_owned(),
            ];
            set.extend(further.iter().map(|s| (*s).to_owned()));
            let spec = echotank_runtime::config_files::load_with(&path, &set);
            let mut spec = spec.expect("a good configuration");
            spec.scene.targets = None;
            assert!(matches!(
                spec.scene.seabed.as_ref().map(|s| &s.shape),
                Some(SeabedShape::Plane { .. })
            ));
            let text = echotank_config::summary(&spec);
            let line = text.lines().find(|l| l.starts_with("scene")).unwrap_or("");
            println!("{line}");
            let mut all = 0;
            for (scatterers, ms) in gathered(&spec) {
                println!("{rig} at {range_m} m: {scatterers} scatterers, gathered in {ms:.1} ms");
                assert!(scatterers > 100, "{rig} at {range_m} m: {scatterers}");
                all += scatterers;
            }
            assert!(all <= most, "{rig} at {range_m} m: {all}");
        }
    });
}
