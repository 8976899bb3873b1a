//! Orientations: in the notation of the space, in the notation of the robot, and interpolated.
//!
//! The space uses rotations about the fixed x, y and z of the base, in sequence. The robot
//! uses a rotation vector: the axis, with the angle as its length.

pub(crate) use skills::frame::{Quaternion, of_angles, to_angles};

/// Converts a rotation vector, rad.
pub(crate) fn of_vector([x, y, z]: [f64; 3]) -> Quaternion {
    let angle = (x * x + y * y + z * z).sqrt();
    let (sine, cosine) = (angle / 2.0).sin_cos();
    // Near the zero rotation the sine equals half the angle.
    let of = if angle > 1e-12 { sine / angle } else { 0.5 };
    [cosine, x * of, y * of, z * of]
}

/// Converts to a rotation vector, rad, of at most half a turn.
pub(crate) fn to_vector([w, x, y, z]: Quaternion) -> [f64; 3] {
    let sign = if w < 0.0 { -1.0 } else { 1.0 };
    let length = (x * x + y * y + z * z).sqrt();
    let angle = 2.0 * length.atan2(w.abs());
    let of = sign * if length > 1e-12 { angle / length } else { 2.0 };
    [x * of, y * of, z * of]
}

/// Returns the angle between two orientations, rad.
pub(crate) fn angle(from: Quaternion, to: Quaternion) -> f64 {
    2.0 * dot(from, to).abs().min(1.0).acos()
}

/// Returns the orientation at a fraction of the way between two orientations, at constant speed.
pub(crate) fn between(from: Quaternion, to: Quaternion, share: f64) -> Quaternion {
    let cosine = dot(from, to);
    let (to, cosine) = if cosine < 0.0 {
        (to.map(|part| -part), -cosine)
    } else {
        (to, cosine)
    };
    let theta = cosine.min(1.0).acos();
    let (of_from, of_to) = if theta < 1e-9 {
        (1.0 - share, share)
    } else {
        let sine = theta.sin();
        (
            ((1.0 - share) * theta).sin() / sine,
            (share * theta).sin() / sine,
        )
    };
    let mut at = from;
    for (at, to) in at.iter_mut().zip(to) {
        *at = *at * of_from + to * of_to;
    }
    let length = dot(at, at).sqrt();
    at.map(|part| part / length)
}

fn dot(a: Quaternion, b: Quaternion) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Converts a position with rotations about x, y and z to a position with a rotation vector.
#[must_use]
pub fn to_robot([x, y, z, a, b, c]: [f64; 6]) -> [f64; 6] {
    let [rx, ry, rz] = to_vector(of_angles([a, b, c]));
    [x, y, z, rx, ry, rz]
}

/// Converts a position with a rotation vector to a position with rotations about x, y and z.
#[must_use]
pub fn of_robot([x, y, z, rx, ry, rz]: [f64; 6]) -> [f64; 6] {
    let [a, b, c] = to_angles(of_vector([rx, ry, rz]));
    [x, y, z, a, b, c]
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, PI};

    use super::*;

    fn near(a: &[f64], b: &[f64]) -> bool {
        a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-9)
    }

    #[test]
    fn an_orientation_is_the_same_after_its_way_to_the_robot() {
        for at in [
            [0.1, -0.2, 0.3, 0.0, 0.0, 0.0],
            [0.1, -0.2, 0.3, 0.3, -1.2, 2.9],
            [0.0, 0.0, 0.0, -3.0, 0.4, 0.0],
            [0.0, 0.0, 0.0, 1e-13, 0.0, 0.0],
        ] {
            assert!(near(&of_robot(to_robot(at)), &at), "{at:?}");
        }
    }

    #[test]
    fn a_rotation_about_one_axis_is_the_same_in_both() {
        assert!(near(
            &to_robot([0.0, 0.0, 0.0, PI, 0.0, 0.0]),
            &[0.0, 0.0, 0.0, PI, 0.0, 0.0]
        ));
        // About x and then about the fixed z, by hand: (2 pi / 3) / sqrt(3) along each axis.
        let third = 2.0 * PI / 3.0 / 3f64.sqrt();
        let vector = to_robot([0.0, 0.0, 0.0, FRAC_PI_2, 0.0, FRAC_PI_2]);
        assert!(
            near(&vector, &[0.0, 0.0, 0.0, third, third, third]),
            "{vector:?}"
        );
    }

    #[test]
    fn halfway_is_half_the_angle() {
        let (from, to) = (of_angles([0.0; 3]), of_angles([0.0, 0.0, 1.0]));
        assert!(near(&to_angles(between(from, to, 0.5)), &[0.0, 0.0, 0.5]));
        assert!((angle(from, to) - 1.0).abs() < 1e-9);
    }
}
