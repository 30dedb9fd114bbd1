use std::time::{Duration, Instant};

use blaze_domain::WhyCode;
use serde_json::json;

use super::*;

