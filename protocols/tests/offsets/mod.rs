//! Golden bytes from a published table: zeros, and the given bytes at each offset.

/// Bytes made of `(offset, value)` pairs, independent of the order of fields in a struct.
#[allow(dead_code, reason = "not every test file has tables")]
pub(crate) fn table(len: usize, fields: &[(usize, &[u8])]) -> Vec<u8> {
    let mut bytes = vec![0; len];
    for (at, value) in fields {
        bytes[*at..at + value.len()].copy_from_slice(value);
    }
    bytes
}

/// Asserts equality and names the first difference.
pub(crate) fn assert_same(got: &[u8], want: &[u8], what: &str) {
    for (at, (g, w)) in got.iter().zip(want).enumerate() {
        assert_eq!(
            g, w,
            "{what}: byte {at} is {g:#04x}, the table says {w:#04x}"
        );
    }
    assert_eq!(got.len(), want.len(), "{what}: length");
}
