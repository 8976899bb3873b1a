//! The reason why a robot does not reach a position.

/// A position that a robot does not reach.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum OutOfWorkspace {
    /// The position is too far from the base.
    #[error("{} is {far:.3} m from its base, and it reaches {reach} m", metres(*position))]
    Reach {
        /// The position, m.
        position: [f64; 3],
        /// Its distance from the base, m.
        far: f64,
        /// The largest distance, m.
        reach: f64,
    },
    /// The position is in no zone.
    #[error("{} is in none of its zones: {}", metres(*position), zones.join(", "))]
    Zones {
        /// The position, m.
        position: [f64; 3],
        /// The names of the zones.
        zones: Vec<String>,
    },
}

fn metres([x, y, z]: [f64; 3]) -> String {
    format!("{x:.3}, {y:.3}, {z:.3} m")
}
