//! Test that the ping path does not allocate after warm-up. It is a separate binary, because it counts with the global allocator.

use std::sync::Arc;

use echotank_config::spec::{
    Density, MultipathSpec, OcclusionSpec, RigSpec, SurfaceSpec, VolumeLayer, VolumeSpec,
};
use echotank_core::instrument::{
    Crosstalk, ElementSpread, Instrument, Leakage, Resonance, SecondSonar, Tone, ToneEntry,
    TransducerResponse,
};
use echotank_core::model::Synthesis;
use echotank_core::pulse::Pulse;
use echotank_core::sound_speed::SoundSpeedProfile;
use echotank_ping::threads::pool;
use echotank_testing::allocations;
use echotank_testing::pings::LoggedPings;

/// Number of allocations in each of the last `watched` pings of `count`.
fn allocations_per_ping(
    file: &str,
    change: impl FnOnce(&mut RigSpec),
    threads: usize,
    count: usize,
    watched: usize,
) -> Vec<u64> {
    let path = echotank_testing::repository()
        .join("hil-configs")
        .join(file);
    let mut spec = echotank_runtime::config_files::load(&path).expect("a good configuration");
    change(&mut spec);
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

/// Every imperfection of an instrument.
fn instrument(pulse: Pulse) -> Instrument {
    let frequency_hz = pulse.center_frequency_hz;
    let resonance = Resonance {
        q: 10.0,
        frequency_hz,
    };
    Instrument {
        leakage: Some(Leakage {
            level_db: -60.0,
            ring_down: Some(resonance),
        }),
        crosstalk: Crosstalk {
            elements_db: Some(-40.0),
            arrays_db: Some(-50.0),
        },
        response: Some(TransducerResponse::Resonance(resonance)),
        element_spread: ElementSpread {
            gain_db: 0.5,
            phase_rad: 0.1,
            ..ElementSpread::default()
        },
        tones: vec![Tone {
            frequency_hz: frequency_hz + 500.0,
            level_db: -80.0,
            phase_rad: 0.0,
            entry: ToneEntry::Input,
        }],
        second_sonars: vec![SecondSonar {
            pulse,
            period_s: 0.013,
            offset_s: 0.0,
            drift_ppm: 10.0,
            bearing_rad: 1.0,
            depression_rad: 0.1,
            level_db: 120.0,
        }],
    }
}

fn bends(spec: &mut RigSpec) {
    let points = vec![(0.0, 1500.0), (20.0, 1480.0), (60.0, 1485.0)];
    let profile = SoundSpeedProfile::new(points).expect("a good profile");
    spec.medium.sound_speed_m_per_s = profile.range_m_per_s().0;
    spec.medium.profile = Some(Arc::new(profile));
}

fn reflects(spec: &mut RigSpec) {
    spec.medium.surface = Some(SurfaceSpec {
        wind_from_rad: Some(0.5),
        heights: true,
        wind_m_per_s: 5.0,
        roughness_m: None,
        slope_rad: None,
        down_m: 0.0,
        scattering: None,
    });
    spec.medium.multipath = Some(MultipathSpec {
        surface_bottom: true,
        bottom_density_ratio: None,
        bottom_speed_ratio: None,
        bottom_roughness_m: None,
        bottom_slope_rad: 0.1,
    });
}

fn scatters(spec: &mut RigSpec) {
    spec.medium.volume = Some(VolumeSpec {
        layers: vec![VolumeLayer {
            top_m: 5.0,
            bottom_m: 6.0,
            sv_db: -60.0,
        }],
        scatterers_per_cell: 1.0,
        nearest_m: 1.0,
    });
}

#[test]
fn a_ping_allocates_nothing_after_warm_up() {
    let _alone = allocations::alone();
    type Change = fn(&mut RigSpec);
    let changes: [(&str, Change); 6] = [
        ("points", |_| {}),
        ("points in a profile", bends),
        ("points and images", reflects),
        ("points and images in a profile", |spec| {
            bends(spec);
            reflects(spec);
        }),
        ("points in water that scatters", scatters),
        ("imperfect points", |spec| {
            for sonar in &mut spec.sonars {
                sonar.instrument = Some(instrument(sonar.pulse));
            }
        }),
    ];
    for threads in [1, 2] {
        for (what, change) in changes {
            let points = allocations_per_ping("points.toml", change, threads, 8, 4);
            assert_eq!(points, [0; 4], "{what}, {threads} threads");
        }
        // Over a seabed, new tiles appear as the ship moves, and a ping may have more scatterers than all before. Both rarely grow
        // a buffer, and nothing else allocates.
        let seabed = allocations_per_ping("quickstart.toml", |_| {}, threads, 36, 20);
        let quiet = seabed.iter().filter(|&&n| n == 0).count();
        assert!(quiet >= 10, "quickstart, {threads} threads: {seabed:?}");
        if threads == 1 {
            continue;
        }
        // Shadows of all legs behind relief and targets.
        let hides = |spec: &mut RigSpec| {
            spec.scene.occlusion = OcclusionSpec::Horizon;
            reflects(spec);
        };
        let hilly = allocations_per_ping("quickstart.toml", hides, threads, 36, 20);
        let quiet = hilly.iter().filter(|&&n| n == 0).count();
        assert!(quiet >= 10, "shadows, {threads} threads: {hilly:?}");
    }
}
