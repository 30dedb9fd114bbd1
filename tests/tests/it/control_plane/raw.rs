//! gRPC by hand: any method, any message, any token.

use std::net::SocketAddr;

use tonic::{Code, Status};

/// A connection that sends what it is told to.
pub(crate) struct Raw {
    http: reqwest::Client,
    at: SocketAddr,
}

impl Raw {
    pub(crate) fn new(at: SocketAddr) -> Self {
        let http = reqwest::Client::builder().no_proxy().http2_prior_knowledge();
        Self {
            http: http.build().unwrap(),
            at,
        }
    }

    /// How the call of `/package.Service/Method` is refused; OK when it is let through, whatever comes of it then.
    pub(crate) async fn call(&self, path: &str, authorization: &[String], message: &[u8]) -> Status {
        let mut frame = vec![0];
        frame.extend(u32::try_from(message.len()).unwrap().to_be_bytes());
        frame.extend(message);
        let mut request = self.http.post(format!("http://{}{path}", self.at)).body(frame);
        request = request
            .header("content-type", "application/grpc")
            .header("te", "trailers");
        for value in authorization {
            request = request.header("authorization", value);
        }
        let response = request.send().await.unwrap();
        assert_eq!(response.status().as_u16(), 200, "{path}");
        // A refusal comes without a message: its status stands in the head of the answer.
        Status::from_header_map(response.headers()).unwrap_or_else(|| Status::new(Code::Ok, ""))
    }
}
