//! What is known of the plant.
