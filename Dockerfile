# docker build -t radarsdf .
# docker run --rm -v "$PWD:/data" radarsdf                                  the demo; it writes /data/radarsdf_demo
# docker run --rm -v "$PWD:/data" radarsdf fit scans.npz -o map.safetensors any other command
# docker run --rm -v "$PWD:/data" -p 127.0.0.1:8080:8080 radarsdf view radarsdf_demo/map.safetensors --host 0.0.0.0
ARG BASE=debian:bookworm-slim

FROM ${BASE} AS build
RUN apt-get update && apt-get install --yes --no-install-recommends g++ python3-dev python3-venv
RUN python3 -m venv /opt/radarsdf
COPY constraints.txt /source/
# As README.md has it: PyTorch without CUDA.
RUN /opt/radarsdf/bin/pip install --no-cache-dir --no-compile --no-deps -c /source/constraints.txt torch \
      --index-url https://download.pytorch.org/whl/cpu || true
COPY . /source
RUN /opt/radarsdf/bin/pip install --no-cache-dir --no-compile -c /source/constraints.txt "/source[plot,view]"
# What only builds and tests of others need. torch/bin holds a program that `import torch` looks for. A fifth of PyTorch is symbols
# for debuggers; libraries that were repaired for their wheels, as NumPy's and SciPy's were, do not load without theirs.
RUN cd /opt/radarsdf/lib/python3*/site-packages \
 && rm -rf pip torch/include torch/share torch/test torch/lib/*test*.so torch/bin/*test* torch/bin/*Test torch/bin/protoc* \
 && strip --strip-unneeded torch/lib/libtorch_cpu.so torch/lib/libtorch_python.so \
 && find . -type d \( -name tests -o -name __pycache__ \) -prune -exec rm -r {} +

FROM ${BASE}
RUN apt-get update && apt-get install --yes --no-install-recommends python3 && rm -rf /var/lib/apt/lists/*
COPY --from=build /opt/radarsdf /opt/radarsdf
ENV PATH=/opt/radarsdf/bin:$PATH PYTHONDONTWRITEBYTECODE=1 MPLBACKEND=Agg MPLCONFIGDIR=/tmp
WORKDIR /data
ENTRYPOINT ["radarsdf"]
CMD ["demo"]
