//! Generates the Rust types of `proto/` without a `protoc` on the machine.

const MESSAGES: [&str; 2] = ["blaze/v1/message.proto", "blaze/link/v1/control.proto"];

fn main() -> Result<(), Box<dyn std::error::Error>> {
    generate()?;
    println!("cargo:rerun-if-changed=proto");
    Ok(())
}

#[cfg(not(feature = "config"))]
fn generate() -> Result<(), Box<dyn std::error::Error>> {
    let descriptors = protox::compile(MESSAGES, ["proto"])?;
    prost_build::Config::new().bytes(["."]).compile_fds(descriptors)?;
    Ok(())
}

#[cfg(feature = "config")]
fn generate() -> Result<(), Box<dyn std::error::Error>> {
    const CONFIG: [&str; 3] =
        ["blaze/v1/config.proto", "blaze/v1/sync.proto", "blaze/v1/status.proto"];

    // What reflection tells: the services and what they need, nothing else of the package.
    let services = protox::compile(CONFIG, ["proto"])?;
    let directory = std::env::var_os("OUT_DIR").ok_or("cargo sets OUT_DIR")?;
    let file = std::path::Path::new(&directory).join("blaze.config.bin");
    std::fs::write(file, prost::Message::encode_to_vec(&services))?;

    // All of package `blaze.v1` comes from one run, because it goes into one file.
    let descriptors = protox::compile(MESSAGES.into_iter().chain(CONFIG), ["proto"])?;
    tonic_prost_build::configure()
        .bytes(".")
        // In the order of their keys, so that the same document is always the same bytes.
        .btree_map(".blaze.v1")
        .compile_fds(descriptors)?;
    Ok(())
}
