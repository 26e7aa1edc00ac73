# Image of the simulator: docker build --tag airl-mav . && docker run --rm airl-mav
FROM python:3.11-slim AS build
WORKDIR /src
COPY . .
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels .

FROM python:3.11-slim
COPY --from=build /wheels /wheels
COPY constraints.txt /tmp/constraints.txt
# The wheel's name contains the version; a requirement with an extra needs its exact path.
RUN pip install --no-cache-dir --constraint /tmp/constraints.txt "$(ls /wheels/*.whl)[sim]" \
    && rm -r /wheels /tmp/constraints.txt \
    && useradd --create-home --uid 1000 airl
USER 1000
WORKDIR /home/airl
# Kernels compile while the image is built, so that a container flies within seconds.
RUN airl-firmware --duration 1
ENTRYPOINT ["airl"]
CMD ["sitl", "--level", "lockstep", "--episodes", "3", "--out", "runs/container"]
