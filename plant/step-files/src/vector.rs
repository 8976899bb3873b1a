//! Points, directions and placements in space. Lengths are in millimetres.

use std::ops::{Add, Mul, Neg, Sub};

/// A point or a direction.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Vector {
    pub(crate) x: f64,
    pub(crate) y: f64,
    pub(crate) z: f64,
}

impl Vector {
    pub(crate) const X: Self = Self::new(1.0, 0.0, 0.0);
    pub(crate) const Y: Self = Self::new(0.0, 1.0, 0.0);
    pub(crate) const Z: Self = Self::new(0.0, 0.0, 1.0);

    pub(crate) const fn new(x: f64, y: f64, z: f64) -> Self {
        Self { x, y, z }
    }

    pub(crate) fn dot(self, other: Self) -> f64 {
        self.x * other.x + self.y * other.y + self.z * other.z
    }

    pub(crate) fn cross(self, other: Self) -> Self {
        Self::new(
            self.y * other.z - self.z * other.y,
            self.z * other.x - self.x * other.z,
            self.x * other.y - self.y * other.x,
        )
    }

    pub(crate) fn length(self) -> f64 {
        self.dot(self).sqrt()
    }

    /// Returns the direction of length 1; `None` if the length is about zero.
    pub(crate) fn unit(self) -> Option<Self> {
        let length = self.length();
        (length > 1e-12 && length.is_finite()).then(|| self * (1.0 / length))
    }
}

impl Add for Vector {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        Self::new(self.x + other.x, self.y + other.y, self.z + other.z)
    }
}

impl Sub for Vector {
    type Output = Self;
    fn sub(self, other: Self) -> Self {
        Self::new(self.x - other.x, self.y - other.y, self.z - other.z)
    }
}

impl Mul<f64> for Vector {
    type Output = Self;
    fn mul(self, by: f64) -> Self {
        Self::new(self.x * by, self.y * by, self.z * by)
    }
}

impl Neg for Vector {
    type Output = Self;
    fn neg(self) -> Self {
        self * -1.0
    }
}

/// A placement: an origin and three axes, right-handed and orthonormal.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Placement {
    pub(crate) origin: Vector,
    pub(crate) x: Vector,
    pub(crate) y: Vector,
    pub(crate) z: Vector,
}

impl Placement {
    #[cfg(test)]
    pub(crate) const IDENTITY: Self = Self {
        origin: Vector::new(0.0, 0.0, 0.0),
        x: Vector::X,
        y: Vector::Y,
        z: Vector::Z,
    };

    /// Creates a placement with an axis, and a direction for x that is made perpendicular to it.
    /// `None` if they are parallel.
    pub(crate) fn new(origin: Vector, axis: Vector, reference: Option<Vector>) -> Option<Self> {
        let z = axis.unit()?;
        let reference = match reference {
            Some(reference) => reference.unit()?,
            // ISO 10303-42, first_proj_axis: x, or y if the axis is x.
            None if (z - Vector::X).length() < 1e-9 || (z + Vector::X).length() < 1e-9 => Vector::Y,
            None => Vector::X,
        };
        let x = reference - z * reference.dot(z);
        let x = if x.length() > 1e-6 {
            x.unit()?
        } else {
            return None;
        };
        let y = z.cross(x);
        Some(Self { origin, x, y, z })
    }

    /// Returns a point of the placement in the outer space.
    pub(crate) fn point(&self, local: Vector) -> Vector {
        self.origin + self.turned(local)
    }

    /// Returns a direction of the placement in the outer space.
    pub(crate) fn turned(&self, local: Vector) -> Vector {
        self.x * local.x + self.y * local.y + self.z * local.z
    }

    /// Returns a point of the outer space in the placement.
    pub(crate) fn local(&self, point: Vector) -> Vector {
        self.local_direction(point - self.origin)
    }

    /// Returns a direction of the outer space in the placement.
    pub(crate) fn local_direction(&self, direction: Vector) -> Vector {
        Vector::new(
            direction.dot(self.x),
            direction.dot(self.y),
            direction.dot(self.z),
        )
    }

    /// Returns the placement that applies `inner` first, and then this one.
    pub(crate) fn after(&self, inner: &Self) -> Self {
        Self {
            origin: self.point(inner.origin),
            x: self.turned(inner.x),
            y: self.turned(inner.y),
            z: self.turned(inner.z),
        }
    }

    pub(crate) fn inverse(&self) -> Self {
        Self {
            origin: self.local_direction(-self.origin),
            x: self.local_direction(Vector::X),
            y: self.local_direction(Vector::Y),
            z: self.local_direction(Vector::Z),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_placement_and_its_inverse_are_the_identity() {
        let placement = Placement::new(
            Vector::new(1.0, 2.0, 3.0),
            Vector::new(1.0, 1.0, 0.0),
            Some(Vector::new(0.2, 0.0, 1.0)),
        )
        .unwrap();
        let same = placement.after(&placement.inverse());
        let point = Vector::new(4.0, -5.0, 6.0);
        assert!((same.point(point) - point).length() < 1e-12);
        assert!((placement.x.cross(placement.y) - placement.z).length() < 1e-12);
        assert_eq!(Placement::new(point, Vector::Z, Some(Vector::Z)), None);
    }
}
