//! Frames as a camera sees them, for tests and measurements.

use crate::testing::Random;

/// 640×480 RGB.
pub(crate) const FRAME_BYTES: usize = WIDTH * HEIGHT * 3;
const WIDTH: usize = 640;
const HEIGHT: usize = 480;

/// One frame: planes of light that fall off, edges, and a sensor whose noise changes every fourth
/// byte or so by one.
pub(crate) fn frame(number: u64) -> Vec<u8> {
    let mut noise = Random(number);
    let moved = usize::try_from(number % 640).unwrap_or(0) * 3;
    let mut out = Vec::with_capacity(FRAME_BYTES);
    for y in 0..HEIGHT {
        for x in 0..WIDTH {
            let (x, shade) = (x + moved, if (x + moved) / 90 % 2 == y / 70 % 2 { 40 } else { 0 });
            let light = [x / 8 + y / 6, x / 16 + 90, y / 4 + 60];
            // One draw for the three channels, a quarter of the bytes are off.
            let mut bits = noise.next();
            for channel in light {
                let off = [0, 0, 0, 1][(bits & 3) as usize];
                bits >>= 2;
                out.push(u8::try_from((channel + shade + off) % 256).unwrap_or(0));
            }
        }
    }
    out
}
