# lidar-mi with CPU builds of everything:
#
#   docker build -t lidar-mi .
#   docker run --rm -v "$PWD:/data" lidar-mi run wake_backscatter -o /data/wake
#
FROM debian:bookworm-slim

# libllvm19 is what Dr.Jit compiles with
RUN apt-get update -q \
    && apt-get install -q -y --no-install-recommends libllvm19 python3-venv \
    && rm -rf /var/lib/apt/lists/*

COPY pyproject.toml README.md LICENSE /source/
COPY lidar_mi /source/lidar_mi
COPY plugins /source/plugins
COPY scenes /source/scenes
RUN python3 -m venv /opt/lidar-mi \
    && /opt/lidar-mi/bin/pip install --no-cache-dir \
        --extra-index-url https://download.pytorch.org/whl/cpu /source \
    && rm -rf /source

RUN useradd --create-home lidar
USER lidar
WORKDIR /data
ENTRYPOINT ["/opt/lidar-mi/bin/lidar-mi"]
CMD ["list"]
