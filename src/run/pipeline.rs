//! One ping through the house.
