//! Test that sizes in file headers are checked before memory is allocated. It is a separate binary, because it counts
//! the memory of the process.

use echotank_config::spec::SeabedFileSpec;
use echotank_scene::read::Survey;
use echotank_scene::read::mesh::{self, MeshAxes};
use echotank_testing::allocations;
use echotank_testing::seeds::{self, Tiff};

fn refusal(name: &str, bytes: Vec<u8>) -> String {
    match Survey::parse(bytes, &SeabedFileSpec::of(name.into())) {
        Ok(s) => format!("read as {}", s.format),
        Err(said) => said.to_string(),
    }
}

#[test]
fn headers_that_promise_too_much_are_refused_before_memory_is_taken() {
    let _alone = allocations::alone();
    let huge = Tiff {
        width: 1_000_000,
        height: 1_000_000,
        ..Tiff::default()
    };
    let mut stl = seeds::stl();
    stl[..5].fill(b' ');
    stl[80..84].copy_from_slice(&u32::MAX.to_le_bytes());
    let mut las = seeds::las();
    // Number of point records of LAS 1.2: 4 million, which is allowed, and 4 thousand million.
    let (mut many, mut most) = (las.clone(), std::mem::take(&mut las));
    many[107..111].copy_from_slice(&4_000_000_u32.to_le_bytes());
    most[107..111].copy_from_slice(&u32::MAX.to_le_bytes());
    let before = allocations::in_use();
    for (name, bytes, want) in [
        (
            "a.asc",
            b"ncols 1000000 nrows 1000000 xllcorner 0 yllcorner 0 cellsize 1 1 2 3".to_vec(),
            "nrows x ncols: `1000000 x 1000000`: may have 67108864 cells at most",
        ),
        (
            "a.asc",
            b"ncols 8000 nrows 8000 xllcorner 0 yllcorner 0 cellsize 1 1 2 3".to_vec(),
            "line 1: `end of file`: reached after 3 numbers; the header declares 8000 x 8000",
        ),
        (
            "a.tif",
            huge.bytes(),
            "tag ImageWidth: `1000000 x 1000000`: may have 67108864 cells at most",
        ),
        (
            "a.ply",
            b"ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\nproperty float x\nend_header\n".to_vec(),
            "PLY header: `4000000000`: at most 16777216 vertex elements are read",
        ),
        (
            "a.ply",
            b"ply\nformat binary_little_endian 1.0\nelement vertex 4000000\nproperty float x\nproperty float y\nproperty float z\nend_header\n".to_vec(),
            "PLY header: `4000000`: vertex elements are declared, more than the file can hold",
        ),
        ("a.las", many, "LAS header: `4000000`: points are declared, more than the file's"),
        ("a.las", most, "LAS header: `4294967295`: at most 4194304 points are read"),
    ] {
        allocations::reset();
        let said = refusal(name, bytes);
        assert!(said.starts_with(want), "{name}: {said}");
        let taken = allocations::highest().saturating_sub(before);
        assert!(taken < 4 << 20, "{name} took {taken} bytes");
    }
    let said = mesh::parse(stl, "stl", MeshAxes::EastNorthUp)
        .unwrap_err()
        .to_string();
    assert!(
        said.starts_with("STL header: `4294967295`: triangles are declared"),
        "{said}"
    );
}
