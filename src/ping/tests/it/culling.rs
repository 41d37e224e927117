//! The scatterers that a ping requests from the scene include all that the transmit leg keeps; strong targets are received in side lobes;
//! shadowed scatterers are those that individually cast rays do not reach.

use std::collections::HashSet;

use echotank_config::spec::{OcclusionSpec, RigSpec, SeabedShape};
use echotank_core::arrays::Mounting;
use echotank_core::frames::{Pose, Trajectory};
use echotank_core::ping::PingPlan;
use echotank_core::scene::{Footprint, Scatterers};
use echotank_ping::pipeline::SonarPipeline;
use echotank_ping::threads::pool;
use echotank_ping::{PingOrder, RangeFloorFinder};
use echotank_runtime::io::files::FileSystem;
use echotank_scene::Scene;
use echotank_scene::{MeshFolder, Targets};
use echotank_synthesis::arrivals::{ArrivalChunk, ArrivalSink};
use echotank_synthesis::echo::culling::left_out_share;
use echotank_synthesis::echo::levels::Directivity;
use echotank_synthesis::echo::{TransmitLeg, Window, Workspace, arrivals, insonify};
use echotank_testing::pings::{LoggedPings, order, plan_on};
use glam::{DQuat, DVec3};
use rayon::prelude::*;

/// Equidistributed over k in each coordinate (Weyl).
fn weyl(k: u32, coordinate: usize) -> f64 {
    (f64::from(k) * [0.754_877_666, 0.569_840_291, 0.327_0][coordinate]).fract()
}

/// On a real log of a ship in a swell, whose attitude changes by degrees within a receive window.
#[test]
fn a_footprint_contains_every_position_received_above_the_floor() {
    let path = echotank_testing::repository().join("hil-configs/quickstart.toml");
    let mut spec = echotank_runtime::config_files::load(&path).expect("a good configuration");
    spec.scene.seabed = None;
    spec.scene.targets = None;
    spec.sonars[0].synthesis.auto = Default::default();
    spec.sonars[0].model.cull_db = Some(-24.0);
    let sonar = spec.sonars[0].clone();
    pool(1).expect("thread").install(|| {
        let mut pings = LoggedPings::open(&spec).expect("rig").expect("nav");
        let (mut heard, mut asked, mut tried) = (0, 0, 0);
        for ping in 0..10 {
            pings.next_ping();
            let plan = &pings.slot.plan;
            let footprints = pings.rig.sonars[0].pipeline.footprints(plan).to_vec();
            assert_eq!(footprints.len(), sonar.receive.len());
            let c = plan.sound_speed_m_per_s;
            let window_s = plan.window_s(sonar.receiver.sample_rate_hz);
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
                    // Arrival of the echo, to a millimetre of platform motion.
                    let back = plan.trajectory.pose_at(2.0 * out_m.length() / c);
                    let contained = footprint.contains(at_m);
                    asked += u32::from(contained);
                    tried += 1;
                    for e in [0, array.elements - 1] {
                        let back_m = at_m - back.point_m(array.element_body_m(e));
                        let received = towards(&element, &back, &array.mounting, back_m);
                        let arrives_s = (out_m.length() + back_m.length()) / c;
                        if sent * received >= floor && arrives_s < window_s {
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

/// Farther from the transmitter than half the window, and nearer to the receiver.
#[test]
fn a_footprint_contains_what_a_distant_receiver_hears() {
    let path = echotank_testing::repository().join("hil-configs/points.toml");
    let mut spec = echotank_runtime::config_files::load(&path).expect("a good configuration");
    let offset_m = -6.0;
    spec.sonars[0].receive[0].mounting.position_m.y += offset_m;
    let transmit_m = spec.sonars[0].transmit[0].mounting.position_m;
    let receive_m = spec.sonars[0].receive[0].mounting.position_m;
    let rate_hz = spec.sonars[0].receiver.sample_rate_hz;
    pool(1).expect("thread").install(|| {
        let mut pings = LoggedPings::open(&spec).expect("rig").expect("nav");
        pings.next_ping();
        let plan = &pings.slot.plan;
        let footprints = pings.rig.sonars[0].pipeline.footprints(plan).to_vec();
        let start = plan.trajectory.pose_at(0.0);
        let apart_m = start.point_m(receive_m) - start.point_m(transmit_m);
        let half_m = 0.5 * plan.sound_speed_m_per_s * plan.window_s(rate_hz);
        // Half the distance between them, less the platform's way.
        let range_m = half_m + 0.4 * apart_m.length();
        let at_m = start.point_m(transmit_m) + apart_m.normalize() * range_m;
        let end = plan.trajectory.pose_at(plan.window_s(rate_hz));
        let way_m = range_m + at_m.distance(end.point_m(receive_m));
        assert!(range_m > half_m && way_m < 2.0 * half_m);
        assert!(footprints[0].contains(at_m), "{range_m} m of {half_m} m");
    });
}

#[test]
fn the_default_floor_takes_half_the_tolerance_and_is_tight_to_one_decibel() {
    let folder = echotank_testing::repository().join("hil-configs");
    let text = std::fs::read_to_string(folder.join("seabed.toml")).expect("readable");
    assert!(!text.contains("\ncull_db"), "the operator gives none");
    for tolerance in [1e-2, 1e-3] {
        let asked = text.replace("tolerance = 1e-3", &format!("tolerance = {tolerance:e}"));
        let spec = echotank_runtime::config_files::parse(&asked, &folder)
            .unwrap_or_else(|e| panic!("{e}"));
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
    let spec =
        echotank_runtime::config_files::parse(&own, &folder).unwrap_or_else(|e| panic!("{e}"));
    assert_eq!(spec.sonars[0].model.cull_db, Some(-30.0));
}

/// Energy of the echoes at one element, range window by range window.
struct Energies {
    window_s: f64,
    sums: Vec<f64>,
}

impl ArrivalSink for Energies {
    fn accept(&mut self, chunk: &ArrivalChunk) {
        for i in 0..chunk.len {
            let window = (chunk.delay_s[i] / self.window_s) as usize;
            if let Some(sum) = self.sums.get_mut(window) {
                *sum += chunk.amplitude[i].norm_sqr();
            }
        }
    }
}

/// The energies of a ping of the port array, and its number of echoes.
fn energies(spec: &RigSpec, plan: &PingPlan, scatterers: &Scatterers) -> (Vec<f64>, u64) {
    let sonar = &spec.sonars[0];
    let (tx, rx) = (&sonar.transmit[0], &sonar.receive[0]);
    let last_s = plan.window_s(sonar.receiver.sample_rate_hz);
    let window = Window {
        first_s: 0.0,
        last_s,
    };
    let (mut lit, mut work) = (TransmitLeg::default(), Workspace::default());
    let window_s = plan.pulse.duration_s;
    let mut all = Energies {
        window_s,
        sums: vec![0.0; (last_s / window_s) as usize],
    };
    insonify(plan, tx, window, scatterers, &mut lit);
    let counts = arrivals(plan, rx, 0, &lit, &mut work, &mut all);
    (all.sums, counts.used)
}

/// Ground that rises ahead returns echoes of side lobes before the main lobe meets it. Floors by range keep two fifths of the tolerance in these
/// weak windows too, down to 55 dB below the strongest; the floor of all ranges does not.
#[test]
fn culling_keeps_its_part_of_the_tolerance_in_weak_windows() {
    let folder = echotank_testing::repository().join("hil-configs");
    let mut spec = echotank_runtime::config_files::load(&folder.join("seabed.toml"))
        .expect("a good configuration");
    spec.scene.targets = None;
    spec.scene.seabed.as_mut().expect("a seabed").shape = SeabedShape::Plane {
        depth_m: 51.0,
        slope_north: -0.7,
        slope_east: 0.0,
    };
    let sonar = spec.sonars[0].clone();
    let tolerance = sonar.synthesis.tolerance;
    let at_rest = Trajectory::uniform(DVec3::ZERO, DVec3::ZERO, DQuat::IDENTITY);
    let mut plan = plan_on(at_rest, &spec, 1, sonar.settings);
    let mut pipeline = SonarPipeline::new(&sonar, &spec.medium).expect("a pipeline");
    let mut scene = Scene::open(&FileSystem, &spec.scene).expect("a scene");
    let mut scatterers = Scatterers::default();
    scene.gather(pipeline.footprints(&plan), &mut scatterers);

    let (by_one_floor, _) = energies(&spec, &plan, &scatterers);
    RangeFloorFinder::default().find(&sonar, &mut plan, &scatterers);
    let (by_range, kept) = energies(&spec, &plan, &scatterers);
    plan.model.cull_db = None;
    let (all, gathered) = energies(&spec, &plan, &scatterers);
    // A window of a pulse length has the beginnings of echoes and the ends of those before.
    let both = |of: &[f64]| -> Vec<f64> { of.windows(2).map(|pair| pair[0] + pair[1]).collect() };
    let all = both(&all);
    let strongest = all.iter().copied().fold(0.0, f64::max);
    let worst = |of: &[f64]| {
        let errors = all.iter().zip(both(of)).map(|(all, of)| {
            let against = all.max(strongest * 10f64.powf(-5.5));
            ((all - of).max(0.0) / against).sqrt()
        });
        errors.fold(0.0, f64::max)
    };
    let (one, own) = (worst(&by_one_floor), worst(&by_range));
    println!(
        "tolerance {tolerance:e}: {one:.1e} with one floor, {own:.1e} with floors by range; {kept} of {gathered} kept"
    );
    assert!(kept < gathered, "nothing is culled");
    assert!(one > tolerance, "{one}");
    assert!(own <= 0.4 * tolerance, "{own}");
}

/// A target of +20 dB in a side lobe too weak for the bottom, and one of -60 dB slightly closer in the same lobe.
#[test]
fn a_strong_target_in_a_side_lobe_is_kept_and_the_culling_error_is_within_the_tolerance() {
    let folder = echotank_testing::repository().join("hil-configs");
    let mut spec = echotank_runtime::config_files::load(&folder.join("seabed.toml"))
        .expect("a good configuration");
    const DEPTH: f64 = 51.0;
    spec.scene.seabed.as_mut().expect("a seabed").shape = SeabedShape::Plane {
        depth_m: DEPTH,
        slope_north: 0.0,
        slope_east: 0.0,
    };
    let sonar = spec.sonars[0].clone();
    let floor = 10f64.powf(sonar.model.cull_db.expect("culled") / 20.0);
    let wavelength_m = spec.medium.sound_speed_m_per_s / sonar.pulse.center_frequency_hz;
    let (tx, rx) = (&sonar.transmit[0], &sonar.receive[0]);
    let level = |at_m: DVec3| {
        let one = |pattern, mounting: &Mounting| {
            let d = Directivity::new(pattern, wavelength_m);
            let u = mounting.body_from_array.inverse() * (at_m - mounting.position_m).normalize();
            d.towards(u.x, u.y, u.z).abs()
        };
        one(&tx.pattern, &tx.mounting) * one(&rx.element_pattern, &rx.mounting)
    };
    // Ahead and to port: the first position where the pattern is well below the floor.
    let below = |east_m: f64| {
        (0..4000)
            .map(|k| DVec3::new(30.0 + 0.01 * f64::from(k), east_m, DEPTH - 1.0))
            .find(|at| (0.2 * floor..0.5 * floor).contains(&level(*at)))
            .expect("a side lobe below the floor")
    };
    let (strong_m, weak_m) = (below(-45.0), below(-30.0));
    let targets = tempfile::tempdir().expect("folder");
    spec.scene.targets = Some(targets.path().join("targets.csv"));
    let table = format!(
        "name,north_m,east_m,height_above_seabed_m,target_strength_db\nstrong,{},{},1,20\nweak,{},{},1,-60\n",
        strong_m.x, strong_m.y, weak_m.x, weak_m.y
    );
    std::fs::write(targets.path().join("targets.csv"), table).expect("written");

    let at_rest = Trajectory::uniform(DVec3::ZERO, DVec3::ZERO, DQuat::IDENTITY);
    let mut plan = plan_on(at_rest, &spec, 1, sonar.settings);
    let mut pipeline = SonarPipeline::new(&sonar, &spec.medium).expect("a pipeline");
    let mut scene = Scene::open(&FileSystem, &spec.scene).expect("a scene");
    let mut scatterers = Scatterers::default();
    let counts = scene.gather(pipeline.footprints(&plan), &mut scatterers);
    assert_eq!(counts.targets, 2);
    let ground = counts.scatterers as usize;
    assert_eq!(scatterers.len(), ground + 2);
    assert!(scatterers.loud[..ground].iter().all(|l| *l == 1.0));

    let (kept, kept_count) = energies(&spec, &plan, &scatterers);
    let mut deaf = scatterers.clone();
    deaf.loud.fill(1.0);
    let (by_pattern, by_pattern_count) = energies(&spec, &plan, &deaf);
    plan.model.cull_db = None;
    let (all, all_count) = energies(&spec, &plan, &scatterers);
    // The element's level differs slightly from the middle's; the weak target is culled and the strong one is not.
    assert_eq!(kept_count, by_pattern_count + 1, "of {all_count}");
    let window_of = |at_m: DVec3| {
        let way_m = at_m.distance(tx.mounting.position_m) + at_m.distance(rx.mounting.position_m);
        (way_m / plan.sound_speed_m_per_s / plan.pulse.duration_s) as usize
    };
    let error = |of: &[f64], window: usize| (1.0 - of[window] / all[window]).max(0.0).sqrt();
    let tolerance = 1e-3;
    let (strong, weak) = (window_of(strong_m), window_of(weak_m));
    println!(
        "floor {floor:.2e}; strong at {:.2e}: error {:.1e}, by the pattern alone {:.1e}; weak {:.1e}",
        level(strong_m),
        error(&kept, strong),
        error(&by_pattern, strong),
        error(&kept, weak)
    );
    assert!(error(&by_pattern, strong) > tolerance);
    for window in [strong, weak] {
        assert!(
            error(&kept, window) < 0.5 * tolerance,
            "{}",
            error(&kept, window)
        );
    }
}

/// Millimetres, as keys of scatterers.
fn key(at: DVec3) -> [i64; 2] {
    [at.x, at.y].map(|m| (m * 1e4).round() as i64)
}

/// On the real seabed, at the times when the container, the wreck, the mooring and the mine are abeam.
#[test]
fn the_shadows_of_the_seabed_configuration_are_those_of_rays_cast_one_by_one() {
    let folder = echotank_testing::repository().join("hil-configs");
    let spec = echotank_runtime::config_files::load(&folder.join("seabed.toml"))
        .expect("a good configuration");
    let sonar = spec.sonars[0].clone();
    pool(2).expect("threads").install(|| {
        let mut pings = LoggedPings::open(&spec).expect("rig").expect("nav");
        let mut unshaded = spec.scene.clone();
        unshaded.occlusion = OcclusionSpec::None;
        let mut unshaded = Scene::open(&FileSystem, &unshaded).expect("scene");
        let own = unshaded.targets()[0].position_m;
        let text = std::fs::read(folder.join("data/seabed_targets.toml")).expect("targets");
        let solids = Targets::parse(&text, Some(MeshFolder { files: &FileSystem, path: &folder.join("data") }), 1, |n, e| {
            unshaded.seabed_down_m(n, e)
        })
        .expect("targets");
        for seconds in [12.0, 25.0, 41.0, 56.0] {
            let order = PingOrder {
                transmit_utc: pings.first_utc.plus_s(seconds),
                ..order(1, sonar.settings)
            };
            assert!(pings.cover(&order), "the log is long enough");
            pings.make(&order).expect("covered");
            let LoggedPings { rig, slot, .. } = &mut pings;
            let anchor_m = rig.targets()[0].position_m - own;
            unshaded.place(anchor_m.x, anchor_m.y);
            let footprints = rig.sonars[0].pipeline.footprints(&slot.plan).to_vec();
            let (mut shaded, mut all) = (Scatterers::default(), Scatterers::default());
            let counts = rig.scene.gather(&footprints, &mut shaded);
            let ground = unshaded.gather(&footprints, &mut all).scatterers as usize;
            let seen: HashSet<_> = (0..counts.scatterers as usize)
                .map(|i| key(shaded.position_m(i)))
                .collect();
            let clear = |at_m: DVec3, eye_m: DVec3| {
                let (at_m, eye_m) = (at_m - anchor_m, eye_m - anchor_m);
                let way_m = eye_m - at_m;
                let length_m = way_m.length();
                let solid = (0..solids.len())
                    .filter_map(|k| solids.solid(k))
                    .any(|solid| solid.hits(at_m, way_m / length_m, length_m));
                // The ground, every half metre: the cells are 2 m wide.
                let steps = (2.0 * length_m).ceil();
                !solid
                    && !(1..steps as usize).any(|k| {
                        let p = at_m + anchor_m + way_m * (k as f64 / steps);
                        unshaded
                            .seabed_down_m(p.x, p.y)
                            .is_some_and(|down_m| down_m < p.z - 1e-3)
                    })
            };
            let visible = |at_m: DVec3, f: &Footprint| {
                f.contains(at_m) && clear(at_m, f.apex_m) && clear(at_m, f.receiver_m)
            };
            // All shadowed scatterers, and every twentieth of the others.
            let wrong: Vec<DVec3> = (0..ground)
                .into_par_iter()
                .map(|i| all.position_m(i))
                .enumerate()
                .filter(|(i, at)| i % 20 == 0 || !seen.contains(&key(*at)))
                .filter(|(_, at)| {
                    let want = footprints.iter().any(|f| visible(*at, f));
                    want != seen.contains(&key(*at))
                })
                .map(|(_, at)| at)
                .collect();
            let dark = ground - seen.len();
            println!(
                "{seconds} s: {ground} heard, {dark} of them in shadow, {} counted with the targets' own; {} wrong",
                counts.shadowed,
                wrong.len()
            );
            assert!(dark > 20, "{seconds} s: {dark} in shadow");
            assert!(counts.shadowed >= dark as u64);
            assert!(wrong.is_empty(), "{:?}", &wrong[..wrong.len().min(5)]);
        }
    });
}
