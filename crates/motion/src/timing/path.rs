//! A smooth path: a sequence of polynomials of degree five or less in a parameter s, which is approximately the distance travelled.
//!
//! Value, first and second derivative are continuous; the third may jump between polynomials. The first derivative is never zero. A path has no
//! timing; it is followed from rest to rest.

/// Number of coefficients of a polynomial: those of s⁰ to s⁵.
const COEFFICIENTS: usize = 6;

/// A path of `N` joints from rest to rest.
#[derive(Debug, Clone, Default)]
pub(crate) struct Path<const N: usize> {
    segments: Vec<Segment<N>>,
    /// The s at which each segment begins.
    starts: Vec<f64>,
    length: f64,
}

/// A polynomial, with s = 0 at its beginning.
#[derive(Debug, Clone)]
pub(crate) struct Segment<const N: usize> {
    pub(crate) length: f64,
    coefficients: [[f64; N]; COEFFICIENTS],
}

/// Position and three derivatives with respect to s.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Derivatives<const N: usize> {
    pub(crate) position: [f64; N],
    pub(crate) first: [f64; N],
    pub(crate) second: [f64; N],
    pub(crate) third: [f64; N],
}

impl<const N: usize> Segment<N> {
    /// A straight segment, parameterised by its length.
    pub(crate) fn line(from: &[f64; N], to: &[f64; N]) -> Segment<N> {
        let length = crate::collision::distance(from, to);
        let mut coefficients = [[0.0; N]; COEFFICIENTS];
        coefficients[0] = *from;
        coefficients[1] = std::array::from_fn(|j| (to[j] - from[j]) / length);
        Segment { length, coefficients }
    }

    /// A Bézier curve of degree five or less, with a parameter from 0 to `length`.
    pub(crate) fn bezier(controls: &[[f64; N]], length: f64) -> Segment<N> {
        let degree = controls.len() - 1;
        let mut coefficients = [[0.0; N]; COEFFICIENTS];
        // The differences of the control points: Δ⁰, Δ¹, … of the first one.
        let mut differences = controls.to_vec();
        let mut factor = 1.0;
        for (k, coefficient) in coefficients.iter_mut().enumerate().take(degree + 1) {
            *coefficient = differences[0].map(|d| d * factor);
            for i in 0..degree - k {
                differences[i] = std::array::from_fn(|j| differences[i + 1][j] - differences[i][j]);
            }
            factor *= (degree - k) as f64 / ((k + 1) as f64 * length);
        }
        Segment { length, coefficients }
    }

    /// A quintic with the given positions and first two derivatives at both ends, with a parameter from 0 to `length`.
    pub(crate) fn between(from: &Derivatives<N>, to: &Derivatives<N>, length: f64) -> Segment<N> {
        let fifth = length / 5.0;
        let bend = length * length / 20.0;
        let near = |end: &Derivatives<N>, way: f64| -> [[f64; N]; 2] {
            let next: [f64; N] = std::array::from_fn(|j| end.position[j] + way * end.first[j]);
            [next, std::array::from_fn(|j| 2.0 * next[j] - end.position[j] + bend * end.second[j])]
        };
        let ([a, b], [d, c]) = (near(from, fifth), near(to, -fifth));
        Segment::bezier(&[from.position, a, b, c, d, to.position], length)
    }

    /// The part of it from one s to another.
    fn part(&self, from: f64, to: f64) -> Segment<N> {
        let mut coefficients = self.coefficients;
        // Taylor shift by repeated Horner schemes.
        for low in 0..COEFFICIENTS - 1 {
            for k in (low..COEFFICIENTS - 1).rev() {
                coefficients[k] = std::array::from_fn(|j| coefficients[k][j] + from * coefficients[k + 1][j]);
            }
        }
        Segment { length: to - from, coefficients }
    }

    /// A cubic from its values and second derivatives at both ends.
    pub(crate) fn cubic(from: &[f64; N], to: &[f64; N], bends: [&[f64; N]; 2], length: f64) -> Segment<N> {
        let mut coefficients = [[0.0; N]; COEFFICIENTS];
        for j in 0..N {
            let [b0, b1] = bends.map(|b| b[j]);
            coefficients[0][j] = from[j];
            coefficients[1][j] = (to[j] - from[j]) / length - length * (2.0 * b0 + b1) / 6.0;
            coefficients[2][j] = b0 / 2.0;
            coefficients[3][j] = (b1 - b0) / (6.0 * length);
        }
        Segment { length, coefficients }
    }

    /// Its value and derivatives at s, counted from its beginning.
    pub(crate) fn at(&self, s: f64) -> Derivatives<N> {
        let [c0, c1, c2, c3, c4, c5] = &self.coefficients;
        let of = |f: &dyn Fn(usize) -> f64| std::array::from_fn(f);
        Derivatives {
            position: of(&|j| c0[j] + s * (c1[j] + s * (c2[j] + s * (c3[j] + s * (c4[j] + s * c5[j]))))),
            first: of(&|j| c1[j] + s * (2.0 * c2[j] + s * (3.0 * c3[j] + s * (4.0 * c4[j] + s * 5.0 * c5[j])))),
            second: of(&|j| 2.0 * c2[j] + s * (6.0 * c3[j] + s * (12.0 * c4[j] + s * 20.0 * c5[j]))),
            third: of(&|j| 6.0 * c3[j] + s * (24.0 * c4[j] + s * 60.0 * c5[j])),
        }
    }

    /// A range that joint `j` does not leave: that of its Bézier control points.
    pub(crate) fn hull(&self, j: usize) -> [f64; 2] {
        const CHOOSE: [[f64; COEFFICIENTS]; COEFFICIENTS] = [
            [1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
            [1.0, 1.0, 0.0, 0.0, 0.0, 0.0],
            [1.0, 2.0, 1.0, 0.0, 0.0, 0.0],
            [1.0, 3.0, 3.0, 1.0, 0.0, 0.0],
            [1.0, 4.0, 6.0, 4.0, 1.0, 0.0],
            [1.0, 5.0, 10.0, 10.0, 5.0, 1.0],
        ];
        let mut power = 1.0;
        let scaled: [f64; COEFFICIENTS] = std::array::from_fn(|k| {
            let scaled = self.coefficients[k][j] * power / CHOOSE[COEFFICIENTS - 1][k];
            power *= self.length;
            scaled
        });
        let point = |i: usize| (0..=i).map(|k| CHOOSE[i][k] * scaled[k]).sum::<f64>();
        let points = (0..COEFFICIENTS).map(point);
        points.fold([f64::INFINITY, f64::NEG_INFINITY], |[least, greatest], p| [least.min(p), greatest.max(p)])
    }

    /// The least and the greatest position of joint `j`.
    pub(crate) fn range(&self, j: usize) -> [f64; 2] {
        let positions = self.coefficients.map(|c| c[j]);
        let extremes = zeros(&slope(&positions), self.length).into_iter().chain([0.0, self.length]);
        let positions = extremes.map(|s| value(&positions, s));
        positions.fold([f64::INFINITY, f64::NEG_INFINITY], |[least, greatest], p| [least.min(p), greatest.max(p)])
    }

    fn is_straight(&self) -> bool {
        self.coefficients[2..].iter().all(|c| c.iter().all(|v| *v == 0.0))
    }

    /// The approximate maximum length of the second derivative.
    pub(crate) fn sharpest(&self) -> f64 {
        let samples = if self.is_straight() { 0 } else { 8 };
        let bends = (0..=samples).map(|i| norm(&self.at(self.length * i as f64 / samples.max(1) as f64).second));
        bends.fold(0.0, f64::max)
    }

    /// Points so close that the chords between them are at most `sagitta` from the curve; both ends are included.
    pub(crate) fn points(&self, sagitta: f64) -> Vec<[f64; N]> {
        let count = (self.length * (self.sharpest() / (8.0 * sagitta)).sqrt()).ceil().clamp(1.0, 64.0);
        (0..=count as usize).map(|i| self.at(self.length * i as f64 / count).position).collect()
    }
}

/// The value of a polynomial at s.
fn value(coefficients: &[f64], s: f64) -> f64 {
    coefficients.iter().rev().fold(0.0, |sum, c| sum * s + c)
}

/// The derivative of a polynomial.
fn slope(coefficients: &[f64]) -> Vec<f64> {
    coefficients.iter().enumerate().skip(1).map(|(k, c)| k as f64 * c).collect()
}

/// The sign changes of a polynomial from 0 to `to`. Between two neighbouring extremes, which are sign changes of its derivative, there is at most
/// one.
fn zeros(coefficients: &[f64], to: f64) -> Vec<f64> {
    /// This many halvings give a zero to the last bits.
    const HALVINGS: usize = 52;
    if coefficients.len() < 2 {
        return Vec::new();
    }
    let mut ends = vec![0.0];
    ends.extend(zeros(&slope(coefficients), to));
    ends.push(to);
    let between = |pair: &[f64]| {
        let (mut low, mut high) = (pair[0], pair[1]);
        let rises = value(coefficients, high) > 0.0;
        if (value(coefficients, low) > 0.0) == rises {
            return None;
        }
        for _ in 0..HALVINGS {
            let middle = (low + high) / 2.0;
            if (value(coefficients, middle) > 0.0) == rises { high = middle } else { low = middle }
        }
        Some((low + high) / 2.0)
    };
    ends.windows(2).filter_map(between).collect()
}

/// The point a share of the way from one point to another.
pub(crate) fn between<const N: usize>(from: &[f64; N], to: &[f64; N], share: f64) -> [f64; N] {
    std::array::from_fn(|j| from[j] + (to[j] - from[j]) * share)
}

pub(crate) fn norm<const N: usize>(v: &[f64; N]) -> f64 {
    v.iter().map(|x| x * x).sum::<f64>().sqrt()
}

impl<const N: usize> Path<N> {
    /// Appends a segment that begins where the path ends, with the same first and second derivative.
    pub(crate) fn push(&mut self, segment: Segment<N>) {
        self.starts.push(self.length);
        self.length += segment.length;
        self.segments.push(segment);
    }

    /// Appends a path that begins where this one ends, with the same first and second derivative.
    pub(crate) fn append(&mut self, path: Path<N>) {
        path.segments.into_iter().for_each(|segment| self.push(segment));
    }

    /// The part of it from one s to another.
    pub(crate) fn part(&self, from: f64, to: f64) -> Path<N> {
        let mut part = Path::default();
        for (segment, start) in self.segments.iter().zip(&self.starts) {
            let (low, high) = ((from - start).max(0.0), (to - start).min(segment.length));
            if high - low > 1e-9 {
                part.push(segment.part(low, high));
            }
        }
        part
    }

    /// Its value and derivatives at s.
    pub(crate) fn at(&self, s: f64) -> Derivatives<N> {
        let index = self.starts.partition_point(|start| *start <= s).saturating_sub(1);
        self.segments[index].at(s - self.starts[index])
    }

    /// The greatest s.
    pub(crate) fn length(&self) -> f64 {
        self.length
    }

    /// The ends of segments: s from 0 to the length.
    pub(crate) fn breaks(&self) -> impl Iterator<Item = f64> + '_ {
        self.starts.iter().copied().chain([self.length])
    }

    /// The segments in order.
    pub(crate) fn segments(&self) -> &[Segment<N>] {
        &self.segments
    }

    /// Whether it is one straight line.
    pub(crate) fn is_line(&self) -> bool {
        self.segments.len() == 1 && self.segments[0].is_straight()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_range_of_a_curve_is_that_of_its_places_and_within_its_hull() {
        let curves = [
            [0.0, 1.0, -2.0, 3.0, -1.0, 0.5],
            [0.3, 0.3, 0.3, 0.3, 0.3, 0.3],
            [0.0, 0.2, 0.4, 0.6, 0.8, 1.0],
            [1.0, -1.0, 1.0, -1.0, 1.0, -1.0],
            [0.0, 2.0, 2.0, -2.0, -2.0, 0.0],
        ];
        for controls in curves {
            for length in [0.01, 0.7, 3.0] {
                let curve = Segment::bezier(&controls.map(|c| [c]), length);
                let places = (0..=10_000).map(|i| curve.at(length * f64::from(i) / 10_000.0).position[0]);
                let (least, greatest) =
                    places.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), p| (a.min(p), b.max(p)));
                let ([low, high], [under, over]) = (curve.range(0), curve.hull(0));
                assert!((low - least).abs() < 1e-7 && (high - greatest).abs() < 1e-7, "{controls:?}: {low} to {high}");
                let [first, last] = [f64::min, f64::max].map(|of| controls.into_iter().reduce(of).unwrap_or(0.0));
                assert!(
                    (under - first).abs() < 1e-12 && (over - last).abs() < 1e-12,
                    "{controls:?}: {under} to {over}"
                );
            }
        }
    }
}
