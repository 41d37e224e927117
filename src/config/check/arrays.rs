//! The receive arrays of a sonar, by the names that beams and outputs use.

use std::collections::HashSet;

use echotank_core::arrays::ArrayGeometry;
use glam::DQuat;

use super::{all, index_of};
use crate::raw::{Field, Problems};

/// Receive arrays that beams and outputs refer to. An entry is `None` if the array has a problem.
pub(crate) struct Arrays<'a> {
    pub names: &'a [Option<&'a str>],
    pub specs: &'a [Option<ArrayGeometry>],
}

impl Arrays<'_> {
    /// Index of the array that `key` names.
    pub(crate) fn named(&self, key: &Field<String>, problems: &mut Problems) -> Option<usize> {
        index_of(key.text()?, key, self.names, "receive array", problems)
    }

    /// Indices of the arrays listed under `arrays`, or of all arrays if the key is absent.
    pub(crate) fn chosen(
        &self,
        arrays: &Field<Vec<String>>,
        problems: &mut Problems,
    ) -> Option<Vec<usize>> {
        if !arrays.given {
            return Some((0..self.specs.len()).collect());
        }
        let entry = arrays;
        let mut seen = HashSet::new();
        let mut chosen = Vec::new();
        for name in arrays.as_ref()? {
            if !seen.insert(name) {
                problems.refuse(entry, format!("contains \"{name}\" twice"));
            }
            chosen.push(index_of(name, entry, self.names, "receive array", problems));
        }
        all(chosen)
    }

    pub(crate) fn body_from_array(&self, index: usize) -> Option<DQuat> {
        let spec = self.specs.get(index)?.as_ref()?;
        Some(spec.mounting.body_from_array)
    }
}
