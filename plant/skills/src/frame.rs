//! Frames: positions and orientations, and their composition.
//!
//! A pose is six numbers: x, y and z in m, and the rotations about the fixed x, y and z axes in
//! rad, in this order.

/// A unit quaternion: w, x, y, z.
pub type Quaternion = [f64; 4];

/// A frame in another frame: the position of its origin and its orientation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Frame {
    position: [f64; 3],
    orientation: Quaternion,
}

impl Frame {
    /// The frame itself.
    pub const IDENTITY: Self = Self {
        position: [0.0; 3],
        orientation: [1.0, 0.0, 0.0, 0.0],
    };

    /// Returns the frame of a pose.
    #[must_use]
    pub fn of_pose([x, y, z, a, b, c]: [f64; 6]) -> Self {
        Self {
            position: [x, y, z],
            orientation: of_angles([a, b, c]),
        }
    }

    /// Returns the frame at this position without a rotation.
    #[must_use]
    pub fn at(position: [f64; 3]) -> Self {
        Self {
            position,
            ..Self::IDENTITY
        }
    }

    /// Returns the pose of the frame.
    #[must_use]
    pub fn pose(&self) -> [f64; 6] {
        let ([x, y, z], [a, b, c]) = (self.position, to_angles(self.orientation));
        [x, y, z, a, b, c]
    }

    /// Returns the position of the origin, m.
    #[must_use]
    pub fn position(&self) -> [f64; 3] {
        self.position
    }

    /// Returns the frame that is `next` within this frame.
    #[must_use]
    pub fn then(&self, next: &Self) -> Self {
        let [x, y, z] = self.position;
        let [dx, dy, dz] = rotated(self.orientation, next.position);
        Self {
            position: [x + dx, y + dy, z + dz],
            orientation: product(self.orientation, next.orientation),
        }
    }

    /// Returns this frame's parent as seen from this frame.
    #[must_use]
    pub fn inverse(&self) -> Self {
        let [w, x, y, z] = self.orientation;
        let orientation = [w, -x, -y, -z];
        let [x, y, z] = rotated(orientation, self.position);
        Self {
            position: [-x, -y, -z],
            orientation,
        }
    }

    /// Returns the distance between the origins of two frames, m.
    #[must_use]
    pub fn distance(&self, other: &Self) -> f64 {
        let apart = self.position.iter().zip(other.position);
        apart.map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
    }
}

/// Converts rotations about x, y and z, rad.
#[must_use]
pub fn of_angles([a, b, c]: [f64; 3]) -> Quaternion {
    let (sa, ca) = (a / 2.0).sin_cos();
    let (sb, cb) = (b / 2.0).sin_cos();
    let (sc, cc) = (c / 2.0).sin_cos();
    [
        ca * cb * cc + sa * sb * sc,
        sa * cb * cc - ca * sb * sc,
        ca * sb * cc + sa * cb * sc,
        ca * cb * sc - sa * sb * cc,
    ]
}

/// Converts to rotations about x, y and z, rad. If the rotation about y is a quarter turn, only the
/// sum of the other rotations counts; the rotation about x is then 0.
#[must_use]
pub fn to_angles([w, x, y, z]: Quaternion) -> [f64; 3] {
    let sine = (2.0 * (w * y - z * x)).clamp(-1.0, 1.0);
    if sine.abs() > QUARTER_TURN {
        let c = -2.0 * sine.signum() * x.atan2(w);
        return [0.0, sine.signum() * std::f64::consts::FRAC_PI_2, c];
    }
    let a = (2.0 * (w * x + y * z)).atan2(1.0 - 2.0 * (x * x + y * y));
    let c = (2.0 * (w * z + x * y)).atan2(1.0 - 2.0 * (y * y + z * z));
    [a, sine.asin(), c]
}

fn product([w, x, y, z]: Quaternion, [v, i, j, k]: Quaternion) -> Quaternion {
    [
        w * v - x * i - y * j - z * k,
        w * i + x * v + y * k - z * j,
        w * j - x * k + y * v + z * i,
        w * k + x * j - y * i + z * v,
    ]
}

fn rotated(by: Quaternion, [x, y, z]: [f64; 3]) -> [f64; 3] {
    let [w, i, j, k] = by;
    let [_, x, y, z] = product(product(by, [0.0, x, y, z]), [w, -i, -j, -k]);
    [x, y, z]
}

/// Sine of the rotation about y from which the other two rotations cannot be distinguished.
const QUARTER_TURN: f64 = 1.0 - 1e-12;

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, PI};

    use super::*;

    fn is_near(a: &[f64], b: &[f64]) -> bool {
        a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-9)
    }

    #[test]
    fn a_frame_and_its_inverse_cancel() {
        for pose in [
            [0.1, -0.2, 0.3, 0.0, 0.0, 0.0],
            [0.1, -0.2, 0.3, 0.3, -1.2, 2.9],
            [0.4, 0.0, 0.1, PI, 0.0, 0.5],
            [0.4, 0.0, 0.1, 0.2, FRAC_PI_2, -0.7],
            [0.4, 0.0, 0.1, 0.2, -FRAC_PI_2, -0.7],
        ] {
            let frame = Frame::of_pose(pose);
            let none = frame.then(&frame.inverse());
            assert!(is_near(&none.pose(), &[0.0; 6]), "{pose:?}: {none:?}");
            let again = Frame::of_pose(frame.pose());
            let same = frame.then(&again.inverse());
            assert!(is_near(&same.pose(), &[0.0; 6]), "{pose:?}: {same:?}");
        }
    }

    #[test]
    fn a_frame_is_turned_with_its_parent() {
        let turned = Frame::of_pose([1.0, 0.0, 0.0, 0.0, 0.0, FRAC_PI_2]);
        let tip = turned.then(&Frame::at([0.5, 0.0, 0.2]));
        assert!(is_near(&tip.position(), &[1.0, 0.5, 0.2]), "{tip:?}");
        let down = Frame::of_pose([0.0, 0.0, 1.0, PI, 0.0, 0.0]);
        let tip = down.then(&Frame::at([0.0, 0.0, 0.2]));
        assert!(is_near(&tip.position(), &[0.0, 0.0, 0.8]), "{tip:?}");
        assert!((tip.distance(&down) - 0.2).abs() < 1e-12);
    }
}
