# Runs `make demo` and `make test` on a bare Debian. Blender 5.2 is not tested, because the image has no Python 3.13.
#
#     docker build -t primdiffusion .
#     docker run --rm --shm-size 2g primdiffusion               # make demo, then make test
#     docker run --rm --shm-size 2g -v "$PWD/demo_out:/primdiffusion/demo_out" primdiffusion make demo
#
# --shm-size: workers of torch's data loader pass batches through /dev/shm, which has only 64 MB in a container.
FROM python:3.11-slim

# The packages of README.md and .ci/run, except python3.11-venv: the image's own Python includes venv.
RUN apt-get update \
    && apt-get install -y --no-install-recommends make git \
        libx11-6 libxrender1 libxfixes3 libxi6 libxkbcommon0 libxext6 libsm6 libice6 libgl1 \
    && rm -rf /var/lib/apt/lists/*

WORKDIR /primdiffusion
COPY . .
RUN make setup
CMD ["make", "demo", "test"]
