//! The angles between two oriented points that the PFH family counts (Rusu et al. 2008, 2009).

/// Pairs handled at once.
pub(super) const LANES: usize = 8;

/// Oriented points, structure of arrays.
#[derive(Debug, Clone, Copy)]
pub(super) struct Points {
    pub position: [[f32; LANES]; 3],
    pub normal: [[f32; LANES]; 3],
}

/// The three angular features of pairs of points: α = v·n₂, φ = u·d/|d| and θ = atan2(w·n₂, u·n₂) in the
/// Darboux frame u = n₁, v = d × u, w = u × v, n₁ being the normal with the smaller angle to the line.
///
/// θ is kept as the two arguments of the arc tangent: to be counted it need only be compared.
#[derive(Debug, Clone, Copy)]
pub(super) struct PairAngles {
    pub theta_y: [f32; LANES],
    pub theta_x: [f32; LANES],
    pub alpha: [f32; LANES],
    pub phi: [f32; LANES],
    /// Whether the frame exists: the points differ and the line is not along the normal.
    pub valid: [bool; LANES],
}

/// Edges of `BINS` equal bins of (-π, π] but the outer two, as pseudo-angles.
#[derive(Debug, Clone, Copy)]
pub(super) struct AngleBins<const BINS: usize> {
    edges: [f32; BINS],
}

impl Points {
    pub(super) const ZERO: Self = Self { position: [[0.0; LANES]; 3], normal: [[0.0; LANES]; 3] };

    /// Puts a point into a lane.
    #[inline(always)]
    pub(super) fn set(&mut self, lane: usize, position: [f32; 3], normal: [f32; 3]) {
        for a in 0..3 {
            self.position[a][lane] = position[a];
            self.normal[a][lane] = normal[a];
        }
    }

    /// One point in every lane.
    #[inline(always)]
    pub(super) fn splat(position: [f32; 3], normal: [f32; 3]) -> Self {
        Self { position: position.map(|v| [v; LANES]), normal: normal.map(|v| [v; LANES]) }
    }
}

impl PairAngles {
    /// Of the pairs (`first`, `second`), lane by lane. The order of a pair matters only where both normals
    /// have exactly the same angle to the line.
    #[inline(always)]
    pub(super) fn new(first: &Points, second: &Points) -> Self {
        let mut angles = Self {
            theta_y: [0.0; LANES],
            theta_x: [0.0; LANES],
            alpha: [0.0; LANES],
            phi: [0.0; LANES],
            valid: [false; LANES],
        };
        for l in 0..LANES {
            let d = [0, 1, 2].map(|a| second.position[a][l] - first.position[a][l]);
            let [n1, n2] = [first, second].map(|p| [0, 1, 2].map(|a| p.normal[a][l]));
            let length = dot(d, d).sqrt();
            let (along1, along2) = (dot(n1, d), dot(n2, d));

            // With the pair reversed d changes its sign, which v = d × u has to follow.
            let reversed = along1.abs() < along2.abs();
            let (u, n) = (select3(reversed, n2, n1), select3(reversed, n1, n2));
            let sign = if reversed { -1.0 } else { 1.0 };
            let (along_u, along_n) = if reversed { (-along2, -along1) } else { (along1, along2) };
            let v = cross(d.map(|x| x * sign), u);
            let v_length = dot(v, v).sqrt();
            let cosine = dot(u, n);

            // w·n = (u × v)·n = d·n - (u·d)(u·n), on the same scale |v| as the cosine is put to.
            angles.theta_y[l] = along_n - along_u * cosine;
            angles.theta_x[l] = cosine * v_length;
            angles.alpha[l] = dot(v, n) / v_length;
            angles.phi[l] = along_u / length;
            angles.valid[l] = v_length > 0.0;
        }
        angles
    }
}

impl<const BINS: usize> AngleBins<BINS> {
    /// Bins of θ.
    pub(super) fn new() -> Self {
        let mut edges = [f32::INFINITY; BINS];
        for (b, edge) in edges.iter_mut().enumerate().skip(1) {
            let (y, x) = (std::f64::consts::PI * (2.0 * b as f64 / BINS as f64 - 1.0)).sin_cos();
            *edge = pseudo_angle(y as f32, x as f32);
        }
        Self { edges }
    }

    /// Number of the bin that atan2(y, x) falls into.
    #[inline(always)]
    pub(super) fn of(&self, y: &[f32; LANES], x: &[f32; LANES]) -> [u32; LANES] {
        let mut bins = [0; LANES];
        for l in 0..LANES {
            let p = pseudo_angle(y[l], x[l]);
            for &edge in &self.edges[1..] {
                bins[l] += u32::from(p >= edge);
            }
        }
        bins
    }
}

/// Number of the one of `bins` equal bins of [-1, 1] that each cosine falls into.
#[inline(always)]
pub(super) fn cosine_bins(cosines: &[f32; LANES], bins: u32) -> [u32; LANES] {
    let mut out = [0; LANES];
    for l in 0..LANES {
        let scaled = (cosines[l] + 1.0) * 0.5 * bins as f32;
        // The comparisons take NaN to 0; they make the conversion one instruction.
        let clamped = if scaled > 0.0 { scaled } else { 0.0 };
        let clamped = if clamped < (bins - 1) as f32 { clamped } else { (bins - 1) as f32 };
        out[l] = clamped as u32;
    }
    out
}

/// Grows with atan2(y, x) from -2 to 2: the place on the square |x| + |y| = 1 in place of that on the circle.
#[inline(always)]
fn pseudo_angle(y: f32, x: f32) -> f32 {
    let p = y / (x.abs() + y.abs());
    if x >= 0.0 { p } else { 2.0_f32.copysign(y) - p }
}

#[inline(always)]
fn select3(second: bool, a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    [0, 1, 2].map(|i| if second { a[i] } else { b[i] })
}

#[inline(always)]
pub(super) fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline(always)]
pub(super) fn cross(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}
